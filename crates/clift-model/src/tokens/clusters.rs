//! Which token belongs to which cluster, on the host and as indices on a device.
// B scenes, N tokens, S centroids, M = N - S members

use burn::tensor::{Bool, Device, Int, Tensor, TensorData};

use crate::error::ModelError;

/// Clusters of one scene. Every cluster holds its centroid; none is empty.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SceneClusters {
    assignment: Vec<u32>,
    centroid_index: Vec<u32>,
}

impl SceneClusters {
    /// Checks and takes the clusters of one scene.
    ///
    /// # Shapes
    /// - `assignment`: cluster of every token, `[num_tokens]`
    /// - `centroid_index`: token that stands for every cluster, `[num_storage_tokens]`
    ///
    /// # Errors
    /// [`ModelError::BadClusters`] when an index is out of range or a centroid is not in its cluster.
    pub fn new(assignment: Vec<u32>, centroid_index: Vec<u32>) -> Result<Self, ModelError> {
        let (tokens, clusters) = (assignment.len(), centroid_index.len());
        if let Some(token) = assignment.iter().position(|&cluster| cluster as usize >= clusters) {
            let what = format!("token {token} is in cluster {} of {clusters}", assignment[token]);
            return Err(ModelError::BadClusters { what });
        }
        for (cluster, &token) in centroid_index.iter().enumerate() {
            match assignment.get(token as usize) {
                Some(&own) if own as usize == cluster => {}
                Some(own) => {
                    let what = format!("token {token}, the centroid of cluster {cluster}, is in cluster {own}");
                    return Err(ModelError::BadClusters { what });
                }
                None => {
                    let what = format!("the centroid of cluster {cluster} is token {token} of {tokens}");
                    return Err(ModelError::BadClusters { what });
                }
            }
        }
        Ok(Self { assignment, centroid_index })
    }

    /// Every token its own cluster: what `num_storage_tokens = num_tokens` means.
    pub fn identity(num_tokens: usize) -> Self {
        let index: Vec<u32> = (0..num_tokens as u32).collect();
        Self { assignment: index.clone(), centroid_index: index }
    }

    /// Cluster of every token, `[num_tokens]`.
    pub fn assignment(&self) -> &[u32] {
        &self.assignment
    }

    /// Token that stands for every cluster, `[num_storage_tokens]`.
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
    /// Puts scenes together.
    ///
    /// # Errors
    /// [`ModelError::BadClusters`] when there is none, or their counts differ.
    pub fn new(scenes: Vec<SceneClusters>) -> Result<Self, ModelError> {
        let counts = |scene: &SceneClusters| (scene.assignment.len(), scene.centroid_index.len());
        let Some(first) = scenes.first().map(counts) else {
            return Err(ModelError::BadClusters { what: "a batch without scenes".into() });
        };
        if let Some(other) = scenes.iter().map(counts).find(|&other| other != first) {
            let what = format!("a batch with {first:?} and {other:?} (tokens, centroids)");
            return Err(ModelError::BadClusters { what });
        }
        Ok(Self { scenes })
    }

    /// The scenes.
    pub fn scenes(&self) -> &[SceneClusters] {
        &self.scenes
    }

    /// Copies the indices to a device in the forms the condenser reads.
    pub fn upload(&self, device: &Device) -> ClusterIndex {
        let batch = self.scenes.len();
        let num_tokens = self.scenes[0].assignment.len();
        let num_storage_tokens = self.scenes[0].centroid_index.len();
        let num_members = num_tokens - num_storage_tokens;
        let mut centroid = Vec::with_capacity(batch * num_storage_tokens);
        let mut member = Vec::with_capacity(batch * num_members);
        let mut segment = Vec::with_capacity(batch * num_members);
        let mut everyone = Vec::with_capacity(batch * num_tokens);
        let mut singleton = vec![true; batch * num_storage_tokens];
        for (scene, clusters) in self.scenes.iter().enumerate() {
            centroid
                .extend(clusters.centroid_index.iter().map(|&token| (scene * num_tokens) as i64 + i64::from(token)));
            for (token, &cluster) in clusters.assignment.iter().enumerate() {
                everyone.push((scene * num_storage_tokens) as i64 + i64::from(cluster));
                if clusters.centroid_index[cluster as usize] as usize != token {
                    let row = scene * num_storage_tokens + cluster as usize;
                    member.push((scene * num_tokens + token) as i64);
                    segment.push(row as i64);
                    singleton[row] = false;
                }
            }
        }
        let index = |values: Vec<i64>| {
            let count = values.len();
            Tensor::<1, Int>::from_data(TensorData::new(values, [count]), device)
        };
        let has_singletons = singleton.contains(&true);
        ClusterIndex {
            batch,
            num_tokens,
            num_storage_tokens,
            centroid: index(centroid),
            segment: index(everyone),
            members: (num_members > 0).then(|| Members { token: index(member), segment: index(segment) }),
            singleton: has_singletons.then(|| {
                Tensor::<3, Bool>::from_data(TensorData::new(singleton, [batch, num_storage_tokens, 1]), device)
            }),
        }
    }
}

/// Indices of a batch of clusters on a device. Rows of scene `b` start at `b * num_tokens` (tokens)
/// and `b * num_storage_tokens` (centroids).
#[derive(Clone, Debug)]
pub struct ClusterIndex {
    pub(crate) batch: usize,
    pub(crate) num_tokens: usize,
    pub(crate) num_storage_tokens: usize,
    /// Token row of every centroid, `[B * S]`.
    pub(crate) centroid: Tensor<1, Int>,
    /// Centroid row of every token, centroids included, `[B * N]`.
    pub(crate) segment: Tensor<1, Int>,
    /// The tokens that are not centroids, if there are any.
    pub(crate) members: Option<Members>,
    /// Clusters of one token, `[B, S, 1]`, if there are any.
    pub(crate) singleton: Option<Tensor<3, Bool>>,
}

/// Tokens that are not centroids.
#[derive(Clone, Debug)]
pub(crate) struct Members {
    /// Their token rows, `[B * M]`.
    pub token: Tensor<1, Int>,
    /// The centroid row each belongs to, `[B * M]`.
    pub segment: Tensor<1, Int>,
}

impl ClusterIndex {
    /// The centroids' rows of a set of tokens.
    ///
    /// # Shapes
    /// - `tokens`: `[batch, num_tokens, dim]`
    /// - returns `[batch, num_storage_tokens, dim]`
    pub fn gather_centroids(&self, tokens: Tensor<3>) -> Tensor<3> {
        self.gather(tokens, &self.centroid)
    }

    /// Rows `index` of the tokens of all scenes: `[B, N, D] -> [B, rows / B, D]`.
    pub(crate) fn gather(&self, tokens: Tensor<3>, index: &Tensor<1, Int>) -> Tensor<3> {
        let [batch, num_tokens, dim] = tokens.dims();
        assert_eq!([batch, num_tokens], [self.batch, self.num_tokens], "[batch, num_tokens] of tokens and clusters");
        let [rows] = index.dims();
        tokens.reshape([batch * num_tokens, dim]).select(0, index.clone()).reshape([batch, rows / batch, dim])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::to_vec;

    #[test]
    fn contradicting_indices_are_refused_with_the_indices() {
        let message = |assignment: &[u32], centroids: &[u32]| {
            SceneClusters::new(assignment.into(), centroids.into()).unwrap_err().to_string()
        };
        assert_eq!(message(&[0, 2], &[0]), "bad clusters: token 1 is in cluster 2 of 1");
        assert_eq!(message(&[0, 0], &[7]), "bad clusters: the centroid of cluster 0 is token 7 of 2");
        let expected = "bad clusters: token 0, the centroid of cluster 1, is in cluster 0";
        assert_eq!(message(&[0, 0], &[1, 0]), expected);
        let scenes = vec![SceneClusters::identity(2), SceneClusters::identity(3)];
        assert!(Clusters::new(scenes).is_err());
        assert!(Clusters::new(Vec::new()).is_err());
    }

    #[test]
    fn gathering_takes_each_scenes_own_rows() {
        let device = Device::flex();
        let clusters = Clusters::new(vec![
            SceneClusters::new(vec![0, 1, 0], vec![2, 1]).expect("valid"),
            SceneClusters::new(vec![1, 0, 1], vec![1, 0]).expect("valid"),
        ])
        .expect("equal counts");
        let index = clusters.upload(&device);
        let tokens = Tensor::<1, Int>::arange(0..6, &device).float().reshape([2, 3, 1]);
        assert_eq!(to_vec(index.gather_centroids(tokens)), [2.0, 1.0, 4.0, 3.0]);
        let members = index.members.expect("one per scene");
        assert_eq!(members.token.into_data().convert::<i64>().try_to_vec::<i64>().expect("ints"), [0, 5]);
        assert_eq!(members.segment.into_data().convert::<i64>().try_to_vec::<i64>().expect("ints"), [0, 3]);
    }
}
