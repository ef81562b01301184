//! The rows without gradient.
// B = 1 scene, V views, N tokens, S stored, M = N - S members, D width

use burn::module::Module;
use burn::tensor::{Device, Int, Tensor, TensorData};
use clift_core::{step_rng, uniform_below};
use clift_model::{Cameras, Clusters, Views, cluster_attention};
use clift_train::{TrainError, seeded_clusters, seeded_uniform};

use crate::cases::context::BenchContext;
use crate::cases::reference::{ToF64, module_on, relative_error};
use crate::cases::task::BenchTask;

/// Returns a result, flattened; computed in f64 on the reference device if one is given.
type Compute = dyn Fn(Option<&Device>) -> Tensor<1>;

pub struct Forward {
    compute: Box<Compute>,
    /// Divisor of the seconds of a repetition.
    num_views: usize,
}

impl Forward {
    fn new(compute: impl Fn(Option<&Device>) -> Tensor<1> + 'static) -> Self {
        Self { compute: Box::new(compute), num_views: 1 }
    }
}

impl BenchTask for Forward {
    fn run(&mut self) -> Result<(), TrainError> {
        (self.compute)(None);
        Ok(())
    }

    fn error(self: Box<Self>, reference: &Device) -> Result<f64, TrainError> {
        Ok(relative_error((self.compute)(None), (self.compute)(Some(reference))))
    }

    fn num_views(&self) -> usize {
        self.num_views
    }
}

pub fn encode(context: &BenchContext) -> Result<Forward, TrainError> {
    let views = Views::upload(&[&context.clip(1).context], &context.device)?;
    let encoder = context.model().encoder.valid();
    Ok(Forward::new(move |reference| module_on(&encoder, reference).forward(&views.on(reference)).values.flatten(0, 2)))
}

pub fn condense(context: &BenchContext) -> Result<Forward, TrainError> {
    let lift = context.lift()?;
    let count = context.num_storage_tokens()?;
    let clusters = Clusters::new(vec![seeded_clusters(lift.dims()[1], count, context.config.seed, 0)?])?;
    let index = clusters.upload(&context.device);
    let condenser = context.model().condenser.valid();
    Ok(Forward::new(move |reference| {
        let moved = reference.map(|reference| clusters.upload(reference));
        let index = moved.as_ref().unwrap_or(&index);
        module_on(&condenser, reference).forward(lift.on(reference), index).values.flatten(0, 2)
    }))
}

/// Attention of every centroid to its members, on random projections.
pub fn attention_in_clusters(context: &BenchContext) -> Result<Forward, TrainError> {
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
    let segment = Tensor::<1, Int>::from_data(TensorData::new(segment, [num_members]), &context.device);
    let query: Tensor<3> = random(count, dim, "bench query");
    let key_value: Tensor<3> = random(num_members, 2 * dim, "bench key and value");
    let num_heads = context.config.model.num_heads;
    Ok(Forward::new(move |reference| {
        let segment = reference.map_or_else(|| segment.clone(), |reference| segment.clone().to_device(reference));
        cluster_attention(query.on(reference), key_value.on(reference), segment, num_heads).flatten(0, 2)
    }))
}

pub fn render(context: &BenchContext, num_views: usize) -> Result<Forward, TrainError> {
    let lift = context.lift()?;
    let targets = Cameras::upload(&[&context.clip(num_views).target], &context.device)?;
    let renderer = context.model().renderer.valid();
    let render = Forward::new(move |reference| {
        module_on(&renderer, reference).forward(lift.on(reference), &targets.on(reference)).flatten(0, 4)
    });
    Ok(Forward { num_views, ..render })
}
