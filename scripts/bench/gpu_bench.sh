#!/usr/bin/env bash
# Carries clift to a GPU machine that needs no network, no compiler and no checkout, and measures it there beside PyTorch:
#   bash scripts/bench/gpu_bench.sh pack FOLDER           # packs a release binary with wgpu and the scripts
#   bash scripts/bench/gpu_bench.sh over USER@HOST [..]   # packs, copies, runs there, and brings gpu.json back
#   bash bench/gpu_bench.sh run [arguments of gpu_bench.py]   # in the packed folder, on the GPU machine
#
# There: a Vulkan driver and loader (Linux), Python 3.11; PyTorch for the comparison (PYTHON=EXE names the Python that has
# it). The binary is linked against this machine's C library: pack on one that is no newer than the GPU machine's.
# `run --tiny` shows in minutes that everything works, on a CPU too (`--device flex`).
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)

pack() {
    local folder=$1 root=$here/../..
    mkdir -p "$folder/bench" "$folder/twin"
    if [ -n "${CLIFT:-}" ]; then
        cp "$CLIFT" "$folder/clift"
    else
        (cd "$root" && cargo build --locked --release --features wgpu)
        cp "${CARGO_TARGET_DIR:-$root/target}/release/clift" "$folder/clift"
    fi
    cp "$here"/gpu_bench.sh "$here"/gpu_bench.py "$here"/bench_rows.py "$here"/torch_cases.py "$folder/bench/"
    cp "$here/../twin/clift_torch.py" "$folder/twin/"
    cp "$root/configs/tiny.toml" "$folder/sizes.toml"
    echo "packed $(du -sh "$folder" | cut -f1) in $folder; there: bash bench/gpu_bench.sh run --json gpu.json"
}

over() {
    local host=$1 folder
    shift
    folder=$(mktemp -d)
    trap 'rm -rf "$folder"' EXIT
    pack "$folder"
    tar -C "$folder" -czf - . | ssh "$host" 'mkdir -p clift-gpu-bench && tar -C clift-gpu-bench -xzf -'
    # shellcheck disable=SC2029  # the arguments are meant to be read there
    ssh "$host" "cd clift-gpu-bench && PYTHON='${PYTHON:-python3}' bash bench/gpu_bench.sh run --json gpu.json $*" ||
        echo "something failed there; gpu.json holds what was measured"
    scp "$host:clift-gpu-bench/gpu.json" gpu.json
}

run() {
    local python=${PYTHON:-python3} config=$here/../sizes.toml clift=${CLIFT:-$here/../clift}
    if [ ! -e "$config" ]; then # in a checkout
        config=$here/../../configs/tiny.toml
    fi
    exec "$python" "$here/gpu_bench.py" --clift "$clift" --config "$config" "$@"
}

case ${1:-} in
pack) pack "${2:?a folder to pack into}" ;;
over) over "${2:?USER@HOST}" "${@:3}" ;;
run) run "${@:2}" ;;
*)
    sed -n '2,10p' "$0"
    exit 2
    ;;
esac
