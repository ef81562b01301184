//! The host of a rank, and its share of the cores and devices there.

use std::num::NonZero;

use burn::tensor::Device;
use clift_core::plural;
use clift_model::DeviceName;

use crate::distributed::ranks::Ranks;
use crate::error::TrainError;

/// Resources that a rank shares with the other ranks of its host.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RankPlace {
    /// Name of the host.
    pub host: String,
    /// Number of this rank on its host, from 0.
    pub local_rank: usize,
    /// Threads for a CPU device: the cores that the rank may use, divided by the ranks that may use the same ones.
    pub num_threads: usize,
}

impl RankPlace {
    /// Finds the ranks that share the host and the cores of this one.
    pub fn find(ranks: &Ranks) -> Result<Self, TrainError> {
        let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
        let cores = status.lines().find_map(|line| line.strip_prefix("Cpus_allowed_list:")).unwrap_or_default();
        let num_cores = std::thread::available_parallelism().map_or(1, NonZero::get);
        let all = ranks.gather((host_name(), cores.trim().to_owned()))?;
        Ok(Self::of(&all, ranks.rank(), num_cores))
    }

    fn of(all: &[(String, String)], rank: usize, num_cores: usize) -> Self {
        let (host, _) = &all[rank];
        let num_sharing = all.iter().filter(|other| **other == all[rank]).count();
        Self {
            host: host.clone(),
            local_rank: all[..rank].iter().filter(|(other, _)| other == host).count(),
            num_threads: (num_cores / num_sharing).max(1),
        }
    }
}

/// Opens the device of this rank; returns descriptions of those of all ranks, too, if there are several.
pub(crate) fn open_device(name: DeviceName, ranks: &Ranks) -> Result<(Device, Vec<String>), TrainError> {
    if ranks.num_ranks() == 1 {
        return Ok((name.open()?, Vec::new()));
    }
    let place = RankPlace::find(ranks)?;
    let (device, adapter) = name.open_nth(place.local_rank)?;
    let text = adapter.unwrap_or_else(|| format!("{name} with {}", plural(place.num_threads, "thread")));
    let all = ranks.gather(format!("{text} of {}", place.host))?;
    Ok((device, all.into_iter().enumerate().map(|(rank, text)| format!("rank {rank}: {text}")).collect()))
}

fn host_name() -> String {
    let name = std::fs::read_to_string("/proc/sys/kernel/hostname").ok();
    let name = name.or_else(|| std::env::var("HOSTNAME").ok()).or_else(|| std::env::var("COMPUTERNAME").ok());
    name.map_or_else(|| "unknown".into(), |name| name.trim().to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ranks_of_a_host_share_its_cores_unless_bound() {
        let place = |all: &[(&str, &str)], rank, num_cores| {
            let all: Vec<_> = all.iter().map(|(host, cores)| ((*host).to_owned(), (*cores).to_owned())).collect();
            let RankPlace { local_rank, num_threads, .. } = RankPlace::of(&all, rank, num_cores);
            [local_rank, num_threads]
        };
        let free = [("a", "0-7"), ("b", "0-7"), ("a", "0-7")];
        assert_eq!([0, 1, 2].map(|rank| place(&free, rank, 8)), [[0, 4], [0, 8], [1, 4]]);
        assert_eq!(place(&[("a", "0"), ("a", "1")], 1, 1), [1, 1]);
        assert_eq!(place(&[("a", "0"), ("a", "0"), ("a", "0")], 2, 2), [2, 1], "more ranks than cores");
    }
}
