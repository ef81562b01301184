//! The cluster of every token, on the host and as indices on a device.
// B scenes, N tokens, S centroids, M = N - S members

use burn::tensor::{Bool, Device, Int, Tensor, TensorData};

use crate::error::ModelError;

/// Clusters of one scene. Every cluster contains its centroid; no cluster is empty.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SceneClusters {
    assignment: Vec<u32>,
    centroid_index: Vec<u32>,
}

impl SceneClusters {
    /// Checks the clusters of one scene.
    ///
    /// # Shapes
    /// - `assignment`: cluster of every token, `[num_tokens]`
    /// - `centroid_index`: centroid token of every cluster, `[num_storage_tokens]`
    pub fn new(assignment: Vec<u32>, centroid_index: Vec<u32>) -> Result<Self, ModelError> {
        let (tokens, clusters) = (assignment.len(), centroid_index.len());
        let bad = |reason: String| Err(ModelError::BadClusters { reason });
        if let Some(token) = assignment.iter().position(|&cluster| cluster as usize >= clusters) {
            return bad(format!("token {token} is in cluster {} of {clusters}", assignment[token]));
        }
        for (cluster, &token) in centroid_index.iter().enumerate() {
            match assignment.get(token as usize) {
                Some(&own) if own as usize == cluster => {}
                Some(own) => {
                    return bad(format!("token {token}, the centroid of cluster {cluster}, is in cluster {own}"));
                }
                None => return bad(format!("the centroid of cluster {cluster} is token {token} of {tokens}")),
            }
        }
        Ok(Self { assignment, centroid_index })
    }

    /// Returns clusters of one token each, for `num_storage_tokens = num_tokens`.
    pub fn identity(num_tokens: usize) -> Self {
        let index: Vec<u32> = (0..num_tokens as u32).collect();
        Self { assignment: index.clone(), centroid_index: index }
    }

    /// Returns the cluster of every token, `[num_tokens]`.
    pub fn assignment(&self) -> &[u32] {
        &self.assignment
    }

    /// Returns the centroid token of every cluster, `[num_storage_tokens]`.
    pub fn centroid_index(&self) -> &[u32] {
        &self.centroid_index
    }
}

/// Clusters of a batch of scenes with the same counts.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Clusters {
    scenes: Vec<SceneClusters>,
}

impl Clusters {
    /// Combines scenes into a batch.
    pub fn new(scenes: Vec<SceneClusters>) -> Result<Self, ModelError> {
        let counts = |scene: &SceneClusters| (scene.assignment.len(), scene.centroid_index.len());
        let Some(first) = scenes.first().map(counts) else {
            return Err(ModelError::BadClusters { reason: "a batch without scenes".into() });
        };
        if let Some(other) = scenes.iter().map(counts).find(|&other| other != first) {
            let reason = format!("a batch with {first:?} and {other:?} (tokens, centroids)");
            return Err(ModelError::BadClusters { reason });
        }
        Ok(Self { scenes })
    }

    /// Returns the clusters of every scene.
    pub fn scenes(&self) -> &[SceneClusters] {
        &self.scenes
    }

    /// Copies the indices to a device, in the layout of the condenser.
    pub fn upload(&self, device: &Device) -> ClusterIndex {
        let batch = self.scenes.len();
        let num_tokens = self.scenes[0].assignment.len();
        let num_storage_tokens = self.scenes[0].centroid_index.len();
        let (mut centroid, mut all_segments) = (Vec::new(), Vec::new());
        let (mut member, mut segment) = (Vec::new(), Vec::new());
        let mut num_members_of = vec![0_u32; batch * num_storage_tokens];
        for (scene, clusters) in self.scenes.iter().enumerate() {
            centroid.extend(clusters.centroid_index.iter().map(|&token| (scene * num_tokens + token as usize) as i64));
            for (token, &cluster) in clusters.assignment.iter().enumerate() {
                let row = scene * num_storage_tokens + cluster as usize;
                all_segments.push(row as i64);
                if clusters.centroid_index[cluster as usize] as usize != token {
                    member.push((scene * num_tokens + token) as i64);
                    segment.push(row as i64);
                    num_members_of[row] += 1;
                }
            }
        }
        let index = |rows: Vec<i64>| Tensor::<1, Int>::from_data(rows.as_slice(), device);
        let per_cluster = [batch, num_storage_tokens, 1];
        let singleton: Vec<bool> = num_members_of.iter().map(|&count| count == 0).collect();
        let member_share: Vec<f32> = num_members_of.iter().map(|&count| count as f32 / (count + 1) as f32).collect();
        ClusterIndex {
            batch,
            num_tokens,
            centroid: index(centroid),
            segment: index(all_segments),
            members: (!member.is_empty()).then(|| Members { token: index(member), segment: index(segment) }),
            singleton: singleton
                .contains(&true)
                .then(|| Tensor::<3, Bool>::from_data(TensorData::new(singleton, per_cluster), device)),
            member_share: Tensor::<3>::from_data(TensorData::new(member_share, per_cluster), device),
        }
    }
}

/// Indices of a batch of clusters on a device. Rows of scene `b` start at `b * num_tokens` (tokens)
/// and `b * num_storage_tokens` (centroids).
#[derive(Clone, Debug)]
pub struct ClusterIndex {
    pub(crate) batch: usize,
    pub(crate) num_tokens: usize,
    /// Token row of every centroid, `[B * S]`.
    pub(crate) centroid: Tensor<1, Int>,
    /// Centroid row of every token, centroids included, `[B * N]`.
    pub(crate) segment: Tensor<1, Int>,
    /// Tokens that are not centroids; `None` without such tokens.
    pub(crate) members: Option<Members>,
    /// Whether a cluster has one token, `[B, S, 1]`; `None` without such clusters.
    pub(crate) singleton: Option<Tensor<3, Bool>>,
    /// Share of members among the tokens of a cluster, `[B, S, 1]`: 0 for a cluster of one token.
    pub(crate) member_share: Tensor<3>,
}

#[derive(Clone, Debug)]
pub(crate) struct Members {
    /// Token row of every member, `[B * M]`.
    pub token: Tensor<1, Int>,
    /// Centroid row of every member, `[B * M]`.
    pub segment: Tensor<1, Int>,
}

impl ClusterIndex {
    /// Selects rows `index` of the tokens of all scenes: `[B, N, D] -> [B, rows / B, D]`.
    pub(crate) fn gather(&self, tokens: Tensor<3>, index: &Tensor<1, Int>) -> Tensor<3> {
        let [batch, num_tokens, dim] = tokens.dims();
        assert_eq!(
            [batch, num_tokens],
            [self.batch, self.num_tokens],
            "tokens and clusters have equal [batch, num_tokens]"
        );
        let [rows] = index.dims();
        tokens.reshape([batch * num_tokens, dim]).select(0, index.clone()).reshape([batch, rows / batch, dim])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn inconsistent_indices_are_refused() {
        let message = |assignment: &[u32], centroids: &[u32]| {
            SceneClusters::new(assignment.into(), centroids.into()).unwrap_err().to_string()
        };
        assert_eq!(message(&[0, 2], &[0]), "bad clusters: token 1 is in cluster 2 of 1");
        assert_eq!(message(&[0, 0], &[7]), "bad clusters: the centroid of cluster 0 is token 7 of 2");
        assert_eq!(message(&[0, 0], &[1, 0]), "bad clusters: token 0, the centroid of cluster 1, is in cluster 0");
        assert!(Clusters::new(vec![SceneClusters::identity(2), SceneClusters::identity(3)]).is_err());
        assert!(Clusters::new(Vec::new()).is_err());
    }
}
