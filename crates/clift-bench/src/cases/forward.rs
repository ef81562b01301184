//! The rows without gradient.
// B = 1 scene, V views, N tokens, S stored, M = N - S members, D width

use burn::module::Module;
use burn::tensor::{Device, Int, Tensor, TensorData};
use clift_data::{step_rng, uniform_below};
use clift_eval::{upload_cameras, upload_views};
use clift_model::{Cameras, ClusterIndex, Clusters, Condenser, Encoder, Renderer, Views, cluster_attention};
use clift_train::{TrainError, seeded_clusters, seeded_uniform};

use crate::cases::context::BenchContext;
use crate::cases::reference::{ToF64, module_in_f64};
use crate::cases::task::Forward;

/// Encoder: context views to tokens.
pub struct EncodeCase {
    encoder: Encoder,
    context: Views,
}

impl EncodeCase {
    pub fn new(context: &BenchContext) -> Result<Self, TrainError> {
        let clip = context.clip(1);
        let views = upload_views(&[&clip.context], &context.device)?;
        Ok(Self { encoder: context.model().encoder.valid(), context: views })
    }
}

impl Forward for EncodeCase {
    fn forward(&self) -> Tensor<1> {
        self.encoder.forward(&self.context).flatten(0, 2)
    }

    fn in_f64(&self, reference: &Device) -> Self {
        Self { encoder: module_in_f64(&self.encoder, reference), context: self.context.in_f64(reference) }
    }
}

/// Condenser: tokens and clusters to condensed tokens.
pub struct CondenseCase {
    condenser: Condenser,
    lift: Tensor<3>,
    clusters: Clusters,
    index: ClusterIndex,
}

impl CondenseCase {
    pub fn new(context: &BenchContext) -> Result<Self, TrainError> {
        let lift = context.lift()?;
        let count = context.num_storage_tokens()?;
        let clusters = Clusters::new(vec![seeded_clusters(lift.dims()[1], count, context.config.seed, 0)?])?;
        let index = clusters.upload(&context.device);
        Ok(Self { condenser: context.model().condenser.valid(), lift, clusters, index })
    }
}

impl Forward for CondenseCase {
    fn forward(&self) -> Tensor<1> {
        self.condenser.forward(self.lift.clone(), &self.index).flatten(0, 2)
    }

    fn in_f64(&self, reference: &Device) -> Self {
        let condenser = module_in_f64(&self.condenser, reference);
        let index = self.clusters.upload(reference);
        Self { condenser, lift: self.lift.in_f64(reference), clusters: self.clusters.clone(), index }
    }
}

/// Attention of every centroid to its members, on random projections.
pub struct ClusterAttentionCase {
    query: Tensor<3>,
    key_value: Tensor<3>,
    segment: Vec<i64>,
    segment_index: Tensor<1, Int>,
    num_heads: usize,
}

impl ClusterAttentionCase {
    pub fn new(context: &BenchContext) -> Result<Self, TrainError> {
        let (count, dim) = (context.num_storage_tokens()?, context.config.model.dim);
        let num_members = context.num_tokens()? - count;
        if num_members == 0 {
            return Err(context.bad_storage("all tokens are stored, which leaves no cluster members: store fewer"));
        }
        // Logits with a deviation of about one: sqrt(3) makes uniform values of unit variance.
        let random = |rows: usize, columns: usize, purpose: &str| {
            seeded_uniform([1, rows, columns], context.config.seed, purpose, &context.device).mul_scalar(3.0_f64.sqrt())
        };
        let mut rng = step_rng(context.config.seed, 0, "bench segments");
        let segment: Vec<i64> = (0..num_members).map(|_| uniform_below(&mut rng, count) as i64).collect();
        Ok(Self {
            query: random(count, dim, "bench query"),
            key_value: random(num_members, 2 * dim, "bench key and value"),
            segment_index: upload(&segment, &context.device),
            segment,
            num_heads: context.config.model.num_heads,
        })
    }
}

fn upload(segment: &[i64], device: &Device) -> Tensor<1, Int> {
    Tensor::from_data(TensorData::new(segment.to_vec(), [segment.len()]), device)
}

impl Forward for ClusterAttentionCase {
    fn forward(&self) -> Tensor<1> {
        let Self { query, key_value, segment_index, num_heads, .. } = self;
        cluster_attention(query.clone(), key_value.clone(), segment_index.clone(), *num_heads).flatten(0, 2)
    }

    fn in_f64(&self, reference: &Device) -> Self {
        Self {
            query: self.query.in_f64(reference),
            key_value: self.key_value.in_f64(reference),
            segment: self.segment.clone(),
            segment_index: upload(&self.segment, reference),
            num_heads: self.num_heads,
        }
    }
}

/// Renderer: the first tokens of a scene and cameras to images.
pub struct RenderCase {
    renderer: Renderer,
    lift: Tensor<3>,
    targets: Cameras,
}

impl RenderCase {
    pub fn new(context: &BenchContext, num_views: usize) -> Result<Self, TrainError> {
        let [_, _, dim] = context.lift()?.dims();
        let lift = context.lift()?.slice([0..1, 0..context.num_render_tokens()?, 0..dim]);
        let targets = upload_cameras(&[&context.clip(num_views).target], &context.device)?;
        Ok(Self { renderer: context.model().renderer.valid(), lift, targets })
    }
}

impl Forward for RenderCase {
    fn forward(&self) -> Tensor<1> {
        self.renderer.forward(self.lift.clone(), &self.targets).flatten(0, 4)
    }

    fn in_f64(&self, reference: &Device) -> Self {
        Self {
            renderer: module_in_f64(&self.renderer, reference),
            lift: self.lift.in_f64(reference),
            targets: self.targets.in_f64(reference),
        }
    }

    fn num_views(&self) -> usize {
        self.targets.dims()[1]
    }
}
