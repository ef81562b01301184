//! Assignments of the tokens of one scene, on the host.

use crate::error::ModelError;
use crate::tokens::clusters::SceneClusters;

/// Relative rounding error of squared distances: the order of summation, which depends on the device, changes them by less.
pub(crate) const ROUNDING: f64 = 1e-4;

/// The cluster of every token of one scene.
#[derive(Clone, Debug)]
pub(crate) struct Labels {
    pub assignment: Vec<u32>,
    /// Squared distance of every token to the mean of its cluster.
    pub distance: Vec<f64>,
}

impl Labels {
    pub fn inertia(&self) -> f64 {
        self.distance.iter().sum()
    }

    /// Moves the token farthest from its mean, from a cluster of at least two tokens, to every empty cluster. Ties go to
    /// the lower index.
    pub fn reseed_empty(&mut self, num_clusters: usize) {
        let mut counts = vec![0_usize; num_clusters];
        self.assignment.iter().for_each(|&cluster| counts[cluster as usize] += 1);
        if !counts.contains(&0) {
            return;
        }
        let mut farthest: Vec<usize> = (0..self.assignment.len()).collect();
        farthest.sort_by(|&a, &b| self.distance[b].total_cmp(&self.distance[a]).then(a.cmp(&b)));
        let mut candidates = farthest.into_iter();
        for cluster in 0..num_clusters {
            if counts[cluster] > 0 {
                continue;
            }
            // A candidate exists: there are at least as many tokens as clusters.
            let Some(token) = candidates.find(|&token| counts[self.assignment[token] as usize] > 1) else { break };
            counts[self.assignment[token] as usize] -= 1;
            counts[cluster] = 1;
            self.assignment[token] = cluster as u32;
            self.distance[token] = 0.0;
        }
    }

    /// Returns the clusters with the token nearest to every mean as centroid. If distances are equal up to [`ROUNDING`],
    /// as in clusters of two tokens, the lower index is the centroid, so that scenes do not depend on the device.
    pub fn nearest_samples(&self, num_clusters: usize) -> Result<SceneClusters, ModelError> {
        let mut nearest: Vec<Option<usize>> = vec![None; num_clusters];
        for (token, &cluster) in self.assignment.iter().enumerate() {
            let best = &mut nearest[cluster as usize];
            if best.is_none_or(|best| self.distance[token] < (1.0 - ROUNDING) * self.distance[best]) {
                *best = Some(token);
            }
        }
        let centroids = nearest.into_iter().flatten().map(|token| token as u32).collect();
        SceneClusters::new(self.assignment.clone(), centroids)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ties_within_rounding_go_to_the_lower_index() {
        let centroids = |distance: [f64; 5]| {
            let labels = Labels { assignment: vec![0, 1, 0, 1, 1], distance: distance.to_vec() };
            labels.nearest_samples(2).expect("valid clusters").centroid_index().to_vec()
        };
        assert_eq!(centroids([2.0, 3.0, 2.0, 1.0, 1.5]), [0, 3]);
        assert_eq!(centroids([2.000_02, 3.0, 1.999_98, 1.000_01, 1.0]), [0, 3]);
        assert_eq!(centroids([2.01, 3.0, 1.99, 1.0, 0.99]), [2, 4], "differences above rounding decide");
    }

    #[test]
    fn empty_clusters_take_the_farthest_tokens_of_larger_clusters() {
        let reseeded = |assignment: [u32; 5], num_clusters| {
            let mut labels = Labels { assignment: assignment.to_vec(), distance: vec![1.0, 3.0, 9.0, 3.0, 0.5] };
            labels.reseed_empty(num_clusters);
            (labels.assignment, labels.distance)
        };
        assert_eq!(reseeded([0, 0, 2, 0, 2], 5), (vec![0, 3, 1, 4, 2], vec![1.0, 0.0, 0.0, 0.0, 0.5]));
        // The farthest token is alone in its cluster.
        assert_eq!(reseeded([0, 0, 2, 0, 0], 4), (vec![0, 1, 2, 3, 0], vec![1.0, 0.0, 9.0, 0.0, 0.5]));
    }
}
