//! Whole runs through the command line: arguments in, files and exit codes out.
//!
//! `training` runs the stages, stops them and resumes them; `evaluation` measures, encodes and renders; `data` converts and
//! checks data sets; `input` is wrong or damaged input; `bench` times the cases; `viewer` opens scenes in a
//! browser. `architecture` and `links` read the sources instead, `documents` runs every command of the documents, `examples`
//! every example.

mod architecture;
mod bench;
mod data;
mod documents;
mod evaluation;
mod examples;
mod input;
mod links;
mod support;
mod training;
mod viewer;
