//! The training curves of a run for its report, from `metrics.jsonl` and `validation.jsonl`.

use std::path::Path;

use clift_eval::TrainingCurve;
use serde::Deserialize;

use crate::events::Stage;

/// The part of a line that a curve needs. A PSNR that was not finite is `null`.
#[derive(Deserialize)]
struct Line {
    stage: Stage,
    step: u64,
    psnr: Option<f64>,
}

/// Reads the curves of both stages. A missing file and a torn line count as no points: the report must not fail for them.
pub(crate) fn training_curves(run_dir: &Path) -> Vec<TrainingCurve> {
    let read = |name: &str| -> Vec<Line> {
        let text = std::fs::read_to_string(run_dir.join(name)).unwrap_or_default();
        text.lines().filter_map(|line| serde_json::from_str(line).ok()).collect()
    };
    let (training, validation) = (read("metrics.jsonl"), read("validation.jsonl"));
    let of = |lines: &[Line], stage: Stage| -> Vec<(u64, f64)> {
        let lines = lines.iter().filter(|line| line.stage == stage);
        lines.filter_map(|line| Some((line.step, line.psnr?))).collect()
    };
    let curve = |stage: Stage| TrainingCurve {
        stage: stage.name(),
        training: of(&training, stage),
        validation: of(&validation, stage),
    };
    let curves = [Stage::Stage1, Stage::Stage2].map(curve).into_iter();
    curves.filter(|curve| !(curve.training.is_empty() && curve.validation.is_empty())).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_of_both_files_are_sorted_by_stage() {
        let folder = tempfile::tempdir().unwrap();
        assert_eq!(training_curves(folder.path()), []);
        let line = |stage: &str, step: u64, psnr: &str| format!(r#"{{"stage":"{stage}","step":{step},"psnr":{psnr}}}"#);
        let metrics = [line("stage1", 1, "9.5"), line("stage1", 2, "null"), line("stage2", 1, "11"), "{\"st".into()];
        std::fs::write(folder.path().join("metrics.jsonl"), metrics.join("\n")).unwrap();
        std::fs::write(folder.path().join("validation.jsonl"), line("stage2", 1, "12")).unwrap();
        let expected = [
            TrainingCurve { stage: "stage1", training: vec![(1, 9.5)], validation: vec![] },
            TrainingCurve { stage: "stage2", training: vec![(1, 11.0)], validation: vec![(1, 12.0)] },
        ];
        assert_eq!(training_curves(folder.path()), expected);
    }
}
