//! The clusters of a scene's tokens, for a JSON file.

use serde::Serialize;

use crate::encode::encode::EncodedScene;

/// The cluster of every token.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct ClusterMap<'a> {
    scene: &'a str,
    /// Context frames; tokens are ordered by frame, row and column of the patch.
    frames: &'a [u32],
    rows: usize,
    columns: usize,
    /// Cluster of each token, which is the index of a token of the scene file.
    assignment: &'a [u32],
    /// Token nearest to the centre of each cluster.
    centroids: &'a [u32],
}

impl<'a> ClusterMap<'a> {
    /// Takes the clusters of an encoded scene.
    pub fn new(encoded: &'a EncodedScene) -> Self {
        let EncodedScene { scene, clusters, .. } = encoded;
        let patch_size = scene.model.patch_size;
        Self {
            scene: &scene.key,
            frames: &scene.context_frames,
            rows: scene.height / patch_size,
            columns: scene.width / patch_size,
            assignment: clusters.assignment(),
            centroids: clusters.centroid_index(),
        }
    }
}
