//! What the host knows of a scene after an assignment.

use crate::error::ModelError;
use crate::tokens::clusters::SceneClusters;

/// Share of a squared distance that is rounding: sums in another order, as another device has them, move it by less.
pub(crate) const ROUNDING: f64 = 1e-4;

/// The cluster of every token of one scene.
#[derive(Clone, Debug)]
pub(crate) struct Labels {
    pub assignment: Vec<u32>,
    /// Squared distance of every token to its cluster's mean.
    pub distance: Vec<f64>,
}

impl Labels {
    /// Sum of all squared distances.
    pub fn inertia(&self) -> f64 {
        self.distance.iter().sum()
    }

    /// Gives every empty cluster the token farthest from its own mean, out of clusters that can spare
    /// one. Lower ids first on ties.
    pub fn fill_empty(&mut self, num_clusters: usize) {
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
            // There are at least as many tokens as clusters, so one of them can be spared.
            let Some(token) = candidates.find(|&token| counts[self.assignment[token] as usize] > 1) else { break };
            counts[self.assignment[token] as usize] -= 1;
            counts[cluster] = 1;
            self.assignment[token] = cluster as u32;
            self.distance[token] = 0.0;
        }
    }

    /// Keeps the sample nearest to every mean; the lower id where rounding alone would decide. The two of a pair are
    /// equally near, and without that a scene would depend on the device that encoded it.
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
    fn the_lower_of_a_pair_is_kept_however_its_distances_are_rounded() {
        let centroids = |distance: [f64; 5]| {
            let labels = Labels { assignment: vec![0, 1, 0, 1, 1], distance: distance.to_vec() };
            labels.nearest_samples(2).expect("valid clusters").centroid_index().to_vec()
        };
        assert_eq!(centroids([2.0, 3.0, 2.0, 1.0, 1.5]), [0, 3]);
        assert_eq!(centroids([2.000_02, 3.0, 1.999_98, 1.000_01, 1.0]), [0, 3]);
        assert_eq!(centroids([2.01, 3.0, 1.99, 1.0, 0.99]), [2, 4], "what is nearer is nearer");
    }
}
