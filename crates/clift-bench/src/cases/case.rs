//! What can be timed, by the name the command line and the JSON give it.

use clift_train::{Stage, TrainError};
use serde::{Serialize, Serializer};

use crate::cases::clustering::Clustering;
use crate::cases::context::BenchContext;
use crate::cases::forward::{ClusterAttend, Condense, Encode, Render};
use crate::cases::selection::Selection;
use crate::cases::step::StepTask;
use crate::cases::task::BenchTask;

/// One row of the table. Names are the same here, in the JSON and in the PyTorch comparison.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum BenchCase {
    /// Context views of one scene to its tokens.
    Encode,
    /// Latent K-means of one scene's tokens.
    Kmeans,
    /// One scene's clusters to its condensed tokens.
    Condense,
    /// The attention of equation 2 alone, without projections.
    ClusterAttention,
    /// Algorithm 1: half of one scene's stored tokens for one view.
    Select,
    /// One view of one scene from all its tokens.
    Render,
    /// Eight views of one scene in one call, sharing its tokens; seconds are per view.
    Render8Views,
    /// An update of stage 1.
    Stage1Step,
    /// The same with a small network of fixed size.
    Stage1StepTiny,
    /// An update of stage 2.
    Stage2Step,
}

impl BenchCase {
    /// All works, in the order they run.
    pub const ALL: [Self; 10] = [
        Self::Encode,
        Self::Kmeans,
        Self::Condense,
        Self::ClusterAttention,
        Self::Select,
        Self::Render,
        Self::Render8Views,
        Self::Stage1Step,
        Self::Stage1StepTiny,
        Self::Stage2Step,
    ];

    /// The name as it is typed and written.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Encode => "encode",
            Self::Kmeans => "kmeans",
            Self::Condense => "condense",
            Self::ClusterAttention => "cluster_attention",
            Self::Select => "select",
            Self::Render => "render",
            Self::Render8Views => "render_8_views",
            Self::Stage1Step => "stage1_step",
            Self::Stage1StepTiny => "stage1_step_tiny",
            Self::Stage2Step => "stage2_step",
        }
    }

    /// Whether the error is of a smaller problem than the time.
    pub const fn is_checked_reduced(self) -> bool {
        matches!(self, Self::Stage1Step | Self::Stage1StepTiny | Self::Stage2Step)
    }

    /// Makes everything the work needs, so that only the work itself is left to be timed.
    pub(crate) fn prepare(self, context: &BenchContext) -> Result<Box<dyn BenchTask>, TrainError> {
        Ok(match self {
            Self::Encode => Box::new(Encode::new(context)?),
            Self::Kmeans => Box::new(Clustering::new(context)?),
            Self::Condense => Box::new(Condense::new(context)?),
            Self::ClusterAttention => Box::new(ClusterAttend::new(context)?),
            Self::Select => Box::new(Selection::new(context)?),
            Self::Render => Box::new(Render::new(context, 1)?),
            Self::Render8Views => Box::new(Render::new(context, 8)?),
            Self::Stage1Step => Box::new(StepTask::new(context, Stage::Stage1)?),
            Self::Stage1StepTiny => Box::new(StepTask::new(&context.tiny(), Stage::Stage1)?),
            Self::Stage2Step => Box::new(StepTask::new(context, Stage::Stage2)?),
        })
    }
}

impl std::fmt::Display for BenchCase {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.pad(self.name())
    }
}

impl std::str::FromStr for BenchCase {
    type Err = String;

    fn from_str(name: &str) -> Result<Self, String> {
        let known = || format!("unknown; the works are {}", Self::ALL.map(Self::name).join(", "));
        Self::ALL.into_iter().find(|work| work.name() == name.trim()).ok_or_else(known)
    }
}

impl Serialize for BenchCase {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(self.name())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_round_trip_and_an_unknown_one_lists_the_known() {
        for work in BenchCase::ALL {
            assert_eq!(work.name().parse(), Ok(work));
        }
        let message = "incode".parse::<BenchCase>().unwrap_err();
        assert!(
            message.starts_with("unknown; the works are encode, kmeans, condense, cluster_attention, select, render, ")
        );
    }
}
