//! The rows without gradient.
// B = 1 scene, V views, N tokens, S stored, M = N - S members, D width

use burn::module::Module;
use burn::tensor::{Device, Int, Tensor, TensorData};
use clift_core::{step_rng, uniform_below};
use clift_model::{Cameras, ClusterIndex, Clusters, Condenser, Encoder, Renderer, Tokens, Views, cluster_attention};
use clift_train::{TrainError, seeded_clusters, seeded_uniform};

use crate::cases::context::BenchContext;
use crate::cases::reference::{ToF64, Weights, relative_error};
use crate::cases::task::BenchTask;

/// A computation without gradient, with a numeric result.
pub struct Forward<I> {
    inputs: I,
    /// Computes the result, flattened.
    compute: fn(&I) -> Tensor<1>,
    /// Divisor of the seconds of a repetition.
    num_views: usize,
}

impl<I> Forward<I> {
    fn new(inputs: I, compute: fn(&I) -> Tensor<1>) -> Self {
        Self { inputs, compute, num_views: 1 }
    }

    pub fn forward(&self) -> Tensor<1> {
        (self.compute)(&self.inputs)
    }
}

impl<I: ToF64> BenchTask for Forward<I> {
    fn run(&mut self) -> Result<(), TrainError> {
        self.forward();
        Ok(())
    }

    fn error(self: Box<Self>, reference: &Device) -> Result<Option<f64>, TrainError> {
        let (result, compute) = (self.forward(), self.compute);
        let inputs = self.inputs.in_f64(reference);
        drop(self);
        Ok(Some(relative_error(result, compute(&inputs))))
    }

    fn num_views(&self) -> usize {
        self.num_views
    }
}

/// Encoder: context views to tokens.
pub fn encode(context: &BenchContext) -> Result<Forward<(Weights<Encoder>, Views)>, TrainError> {
    let views = Views::upload(&[&context.clip(1).context], &context.device)?;
    let encoder = Weights(context.model().encoder.valid());
    Ok(Forward::new((encoder, views), |(encoder, views)| encoder.0.forward(views).values.flatten(0, 2)))
}

/// Clusters with their indices on a device.
pub struct UploadedClusters {
    clusters: Clusters,
    index: ClusterIndex,
}

impl ToF64 for UploadedClusters {
    fn in_f64(&self, reference: &Device) -> Self {
        Self { clusters: self.clusters.clone(), index: self.clusters.upload(reference) }
    }
}

/// Condenser: tokens and clusters to condensed tokens.
pub fn condense(context: &BenchContext) -> Result<Forward<(Weights<Condenser>, Tokens, UploadedClusters)>, TrainError> {
    let lift = context.lift()?;
    let count = context.num_storage_tokens()?;
    let clusters = Clusters::new(vec![seeded_clusters(lift.dims()[1], count, context.config.seed, 0)?])?;
    let clusters = UploadedClusters { index: clusters.upload(&context.device), clusters };
    let condenser = Weights(context.model().condenser.valid());
    Ok(Forward::new((condenser, lift, clusters), |(condenser, lift, clusters)| {
        condenser.0.forward(lift.clone(), &clusters.index).values.flatten(0, 2)
    }))
}

/// Query, key with value, the centroid of every member, and the number of heads.
type AttentionInputs = ([Tensor<3>; 2], Tensor<1, Int>, usize);

/// Attention of every centroid to its members, on random projections.
pub fn attention_in_clusters(context: &BenchContext) -> Result<Forward<AttentionInputs>, TrainError> {
    let (count, dim) = (context.num_storage_tokens()?, context.config.model.dim);
    let num_members = context.num_tokens()? - count;
    if num_members == 0 {
        return Err(context.bad_stored_tokens("all tokens are stored, which leaves no cluster members: store fewer"));
    }
    // Logits with a deviation of about one: sqrt(3) makes uniform values of unit variance.
    let random = |rows: usize, columns: usize, purpose: &str| {
        seeded_uniform([1, rows, columns], context.config.seed, purpose, &context.device).mul_scalar(3.0_f64.sqrt())
    };
    let mut rng = step_rng(context.config.seed, 0, "bench segments");
    let segment: Vec<i64> = (0..num_members).map(|_| uniform_below(&mut rng, count) as i64).collect();
    let segment = Tensor::from_data(TensorData::new(segment, [num_members]), &context.device);
    let tokens = [random(count, dim, "bench query"), random(num_members, 2 * dim, "bench key and value")];
    let inputs = (tokens, segment, context.config.model.num_heads);
    Ok(Forward::new(inputs, |([query, key_value], segment, num_heads)| {
        cluster_attention(query.clone(), key_value.clone(), segment.clone(), *num_heads).flatten(0, 2)
    }))
}

/// Renderer: the first tokens of a scene and cameras to images.
pub fn render(
    context: &BenchContext,
    num_views: usize,
) -> Result<Forward<(Weights<Renderer>, Tokens, Cameras)>, TrainError> {
    let ids: Vec<u32> = (0..context.num_render_tokens()? as u32).collect();
    let lift = context.lift()?.select(&ids);
    let targets = Cameras::upload(&[&context.clip(num_views).target], &context.device)?;
    let renderer = Weights(context.model().renderer.valid());
    let render = Forward::new((renderer, lift, targets), |(renderer, lift, targets)| {
        renderer.0.forward(lift.clone(), targets).flatten(0, 4)
    });
    Ok(Forward { num_views, ..render })
}
