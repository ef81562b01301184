//! Metrics, baselines, evaluation sweeps and their pictures
