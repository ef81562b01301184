#!/usr/bin/env bash
# The sweep of a GPU in six minutes: kernels, whole updates and training of clift, beside PyTorch. The GPU machine needs no
# network, compiler or checkout:
#   bash scripts/bench/gpu_bench.sh pack FOLDER [CHUNKS]   # packs release binaries and scripts into FOLDER and FOLDER.tar.xz
#   bash scripts/bench/gpu_bench.sh over USER@HOST [..]    # packs, copies, runs there, and brings gpu.json back
#   bash bench/gpu_bench.sh run [arguments of gpu_bench.py]    # in the unpacked folder, on the GPU machine
#
# CHUNKS is a data set in chunks (docs/guide/data.md), of which the first are copied; without it training uses synthetic
# scenes. CLIFT (WGSL), CLIFT_SPIRV and SWEEP name binaries that are built already; empty ones are left out.
# There: a Vulkan driver and loader (Linux), Python 3.11; PyTorch for the comparison (PYTHON=EXE names the Python that has
# it). The binaries are linked against this machine's C library: pack on one that is no newer than the GPU machine's.
# `run --tiny` shows that everything works, on software Vulkan or a CPU too (`--device flex`).
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
max_mb=40
max_chunks_mb=10

# Builds what no variable names, and copies it without symbols.
pack_binaries() {
    local folder=$1 root=$here/../.. target
    local spirv=(-p clift -p clift-cube --features clift/wgpu,clift-cube/spirv)
    target=${CARGO_TARGET_DIR:-$root/target}/release
    build() { (cd "$root" && cargo build --locked --release "$@"); }
    [ -n "${CLIFT+set}" ] || build --features wgsl
    [ -z "${CLIFT-built}" ] || strip -o "$folder/clift" "${CLIFT:-$target/clift}"
    # With SPIR-V the program takes the place of the first in the target folder.
    [ -n "${CLIFT_SPIRV+set}" ] || build "${spirv[@]}" --bin clift
    [ -z "${CLIFT_SPIRV-built}" ] || strip -o "$folder/clift-spirv" "${CLIFT_SPIRV:-$target/clift}"
    [ -n "${SWEEP+set}" ] || build "${spirv[@]}" --example sweep
    [ -z "${SWEEP-built}" ] || strip -o "$folder/sweep" "${SWEEP:-$target/examples/sweep}"
}

# Copies the first chunks of the training split, at least one.
pack_chunks() {
    python3 - "$1/train" "$2/train" $((max_chunks_mb * 1000000)) <<'PYTHON'
import json, pathlib, shutil, sys

source, to, room = pathlib.Path(sys.argv[1]), pathlib.Path(sys.argv[2]), int(sys.argv[3])
index = json.loads((source / "index.json").read_text())
chunks = []
for chunk in sorted(set(index.values())):
    room -= (source / chunk).stat().st_size
    if room < 0 and chunks:
        break
    chunks.append(chunk)
to.mkdir(parents=True)
for chunk in chunks:
    shutil.copyfile(source / chunk, to / chunk)
(to / "index.json").write_text(json.dumps({key: chunk for key, chunk in index.items() if chunk in chunks}))
print(f"chunks: {len(chunks)}")
PYTHON
}

pack() {
    local folder=$1 chunks=${2:-} size
    rm -rf "$folder"/{clift,clift-spirv,sweep,data}
    mkdir -p "$folder/bench" "$folder/twin"
    folder=$(cd "$folder" && pwd)
    if [ -n "$chunks" ]; then
        pack_chunks "$chunks" "$folder/data"
        ln -s train "$folder/data/test"
    fi
    pack_binaries "$folder"
    cp "$here"/gpu_bench.sh "$here"/gpu_bench.py "$here"/bench_rows.py "$here"/torch_cases.py "$folder/bench/"
    cp "$here"/../twin/{clift,lvsm}_torch.py "$folder/twin/"
    cp "$here/../../configs/tiny.toml" "$folder/sizes.toml"
    cp "$here/../../configs/re10k.toml" "$folder/"
    tar -C "$folder" -c . | xz -T1 --x86 --lzma2=preset=9 >"$folder.tar.xz"
    size=$((($(stat -c %s "$folder.tar.xz") + 999999) / 1000000))
    if [ "$size" -gt "$max_mb" ]; then
        echo "$folder.tar.xz has $size MB, at most $max_mb are accepted: pack fewer chunks, or leave out a binary (CLIFT=)" >&2
        du -sh "$folder"/* >&2
        exit 1
    fi
    echo "packed: $size MB in $folder.tar.xz; there: tar -xf (or python3 -m tarfile -e), then bash bench/gpu_bench.sh run"
}

over() {
    local host=$1 folder
    shift
    folder=$(mktemp -d)
    trap 'rm -rf "$folder"' EXIT
    pack "$folder/clift-gpu-bench"
    ssh "$host" 'mkdir -p clift-gpu-bench && tar -C clift-gpu-bench -xJf -' <"$folder/clift-gpu-bench.tar.xz"
    # shellcheck disable=SC2029  # the arguments are meant to be read there
    ssh "$host" "cd clift-gpu-bench && PYTHON='${PYTHON:-python3}' bash bench/gpu_bench.sh run $*" ||
        echo "something failed there; gpu.json holds what was measured"
    scp "$host:clift-gpu-bench/gpu.json" gpu.json
}

case ${1:-} in
pack) pack "${2:?a folder to pack into}" "${3:-}" ;;
over) over "${2:?USER@HOST}" "${@:3}" ;;
run) exec "${PYTHON:-python3}" "$here/gpu_bench.py" "${@:2}" ;;
*)
    sed -n '2,12p' "$0"
    exit 2
    ;;
esac
