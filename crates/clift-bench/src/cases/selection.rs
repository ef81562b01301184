//! The row of token selection, which runs on the host.

use burn::tensor::Device;
use clift_core::{Camera, DVec3, step_rng};
use clift_model::{SelectionPreset, Selector, TokenRay};
use clift_train::TrainError;
use rand::RngExt;

use crate::cases::context::BenchContext;
use crate::cases::task::BenchTask;

/// Algorithm 1 of the paper: half of a scene's stored tokens for one view.
pub struct SelectionCase {
    selector: Selector,
    camera: Camera,
    size: [usize; 2],
    num_render_tokens: usize,
}

impl SelectionCase {
    pub fn new(context: &BenchContext) -> Result<Self, TrainError> {
        let count = context.num_storage_tokens()?;
        let clip = context.clip(1);
        let mut rng = step_rng(context.config.seed, 0, "bench rays");
        // A random pixel of every context view in turn.
        let rays: Vec<TokenRay> = (0..count)
            .map(|token| {
                let pose = clip.context.cameras[token % clip.context.num_views()].c2w;
                let [x, y] = [0, 1].map(|_| rng.random_range(-0.5..0.5));
                let direction = pose.rotation * DVec3::new(x, y, 1.0);
                TokenRay { origin: pose.translation, direction }
            })
            .collect();
        Ok(Self {
            selector: Selector::new(SelectionPreset::Paper.rules(), &rays)?,
            camera: clip.target.cameras[0],
            size: context.shape().size,
            num_render_tokens: count.div_ceil(2),
        })
    }
}

impl BenchTask for SelectionCase {
    fn run(&mut self) -> Result<(), TrainError> {
        let [height, width] = self.size;
        self.selector.select(&self.camera, height, width, self.num_render_tokens)?;
        Ok(())
    }

    /// Returns no error: token ids are integers. The tests of clift-model compare them with a brute-force search.
    fn error(self: Box<Self>, _reference: &Device) -> Result<Option<f64>, TrainError> {
        Ok(None)
    }
}
