#!/usr/bin/env bash
# Attacks every reader with damaged files, by default ten minutes each:
#   bash scripts/check/attack.sh [SECONDS] [more arguments of clift-attack: --seed 3, --target pickle]
#
# What is found lies in findings/ afterwards; this attacks again from that input on:
#   clift-attack --target NAME --seed SEED --first NUMBER --seconds 1
set -euo pipefail
cd "$(dirname "$0")/../.."
seconds=${1:-600}
shift || true
# The whole workspace, so that no dependency is built with other features than for the tests.
cargo build --locked --release --workspace --bins
"${CARGO_TARGET_DIR:-target}/release/clift-attack" --seconds "$seconds" "$@"
