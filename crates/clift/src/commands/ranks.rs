//! The ranks that a launcher started.

use std::rc::Rc;

use clift_train::{Launched, RankPlace, Ranks, TrainError};

use crate::threads;
use crate::verbosity::Verbosity;

/// Connects the processes of a launcher, and gives each its share of the cores. From now on only rank 0 prints.
pub fn connect() -> Result<Rc<Ranks>, TrainError> {
    let launched = Launched::find();
    if launched.rank > 0 {
        Verbosity::Silent.choose();
    }
    let ranks = launched.connect()?;
    if ranks.num_ranks() > 1 {
        threads::start(Some(RankPlace::find(&ranks)?.num_threads));
    }
    Ok(Rc::new(ranks))
}

/// Ends the work of all ranks. Rank 0 alone returns an error, its own or that of another rank: a launcher ends the other
/// ranks with the first that fails.
pub fn finish(ranks: &Ranks, result: anyhow::Result<()>) -> anyhow::Result<()> {
    let result = ranks.finish(result);
    if ranks.is_root() { result } else { Ok(()) }
}
