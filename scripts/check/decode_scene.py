"""Decodes a scene file with coded tokens (version 7), as docs/reference/files.md describes it.

usage: decode_scene.py SCENE.clift CODEC.safetensors [--write FILE | --check FILE]

Prints the shape of the tokens and their patches. `--write` writes the tokens as 32-bit floats; `--check` compares them with
such a file and exits with 1 if any differs by more than 1e-5 of the largest.
"""

import json
import struct
import sys
import zlib

import numpy as np

TOTAL, MIN_ESCAPE, MAX_LEVEL = 1 << 16, 64, 1023
LIMITS = [1, 2, 5, 13]


def open_safetensors(path):
    data = open(path, "rb").read()
    (length,) = struct.unpack("<Q", data[:8])
    header = json.loads(data[8 : 8 + length])
    types = {"F32": "<f4", "F64": "<f8", "U8": "u1"}
    fields, start = header.pop("__metadata__"), 8 + length
    spans = {name: [start + offset for offset in info["data_offsets"]] for name, info in header.items()}
    read = {n: np.frombuffer(data[a:b], types[header[n]["dtype"]]).reshape(header[n]["shape"]) for n, (a, b) in spans.items()}
    return data, fields, read


class Decoder:
    def __init__(self, words):
        self.words, self.state = list(words), 0
        while self.words and self.state < 1 << 32:
            self.state = self.state << 32 | self.words.pop()

    def next(self, starts):
        """Returns the symbol whose quantiles are starts[symbol] to starts[symbol + 1]."""
        quantile = self.state % TOTAL
        symbol = int(np.searchsorted(starts, quantile, "right")) - 1
        start, end = int(starts[symbol]), int(starts[symbol + 1])
        self.state = (self.state >> 16) * (end - start) + quantile - start
        if self.state < 1 << 32 and self.words:
            self.state = self.state << 32 | self.words.pop()
        return symbol

    def bit(self):
        return self.next([0, TOTAL // 2, TOTAL])


def table(knots, cumulative, ratio):
    levels = int(min(np.floor(8.0 / ratio + 0.5), MAX_LEVEL))
    x = (np.arange(-levels, levels + 2) - 0.5) * ratio
    right = np.clip(np.searchsorted(knots, x, "right"), 1, len(knots) - 1)
    x0, x1, p0, p1 = knots[right - 1], knots[right], cumulative[right - 1], cumulative[right]
    below = np.where(x < knots[0], 0.0, np.where(x >= knots[-1], 1.0, p0 + (p1 - p0) * ((x - x0) / (x1 - x0))))
    sizes = 1 + np.floor(np.diff(below) * (TOTAL - MIN_ESCAPE - (2 * levels + 1))).astype(int)
    return levels, np.concatenate([[0], np.cumsum(sizes), [TOTAL]])


def level(decoder, levels, starts):
    symbol = decoder.next(starts)
    if symbol <= 2 * levels:
        return symbol - levels
    sign, count, beyond = decoder.bit(), 0, 1
    while decoder.bit():
        count += 1
    for _ in range(count):
        beyond = beyond << 1 | decoder.bit()
    return -(beyond + levels) if sign else beyond + levels


def neighbours(ids, rows, columns):
    """Returns class and the two nearest earlier tokens of the view of every token; the first of a view has itself."""
    places, found = [(i // (rows * columns), i // columns % rows, i % columns) for i in ids], []
    for token, (view, row, column) in enumerate(places):
        others = [((r - row) ** 2 + (c - column) ** 2, -i) for i, (v, r, c) in enumerate(places[:token]) if v == view]
        nearest = (sorted(others) * 2)[:2]
        group = int(np.searchsorted(LIMITS, nearest[0][0])) if nearest else len(LIMITS) + 1
        found.append((group, [-other for _, other in nearest] or [token, token]))
    return found


def decode(scene_path, codec_path):
    data, fields, scene = open_safetensors(scene_path)
    _, info, codec = open_safetensors(codec_path)
    assert fields["version"] == "7" and zlib.crc32(data[:-4]) == struct.unpack("<I", data[-4:])[0], "damaged"
    body, count = scene["scene"].tobytes(), int(fields["tokens"])
    patch, (views, height, width) = json.loads(info["model"])["patch_size"], map(int, fields["views"].split("x"))
    rows, columns = height // patch, width // patch
    step = float(np.frombuffer(body[:4], "<f4")[0])
    (num_intrinsics,) = struct.unpack_from("<I", body, 4 + 48)
    start = 4 + 48 + 4 + 16 * num_intrinsics + 32 * views
    (groups,) = struct.unpack_from("<H", body, start)
    members = sum(struct.unpack_from(f"<{groups}H", body, start + 2))
    patches = members * rows * columns
    start += -(-2 * (1 + groups + members) // 4) * 4 + (48 * groups if groups > 1 else 0)
    decoder = Decoder(np.frombuffer(body[start:-4], "<u4").tolist())
    ids = []
    for index in range(patches):
        left, rest = count - len(ids), patches - index
        size = min(max(TOTAL * left // rest, 1), TOTAL - 1)
        if left == rest or (left > 0 and decoder.next([0, size, TOTAL]) == 0):
            ids.append(index)
    knots, deviations = codec["knots"].astype(float), codec["deviations"].astype(float)
    levels, weights, scales = np.zeros((count, len(deviations))), codec["weights"].astype(float), codec["scales"].astype(float)
    near = neighbours(ids, rows, columns)
    for direction, deviation in enumerate(deviations):
        ratio, reach = step / deviation, np.abs(weights[:, direction]).sum(1)
        spreads = np.sqrt(scales[:, direction] * scales[:, direction] + reach * reach * min(ratio * ratio / 12.0, 1.0))
        tables = [table(knots, codec["cumulative"][direction].astype(float), ratio / spread) for spread in spreads]
        for token, (group, nearest) in enumerate(near):
            products = weights[group, direction] * levels[nearest, direction]
            expected = np.floor(products[0] + products[1] + 0.5)
            levels[token, direction] = expected + level(decoder, *tables[group])
    assert decoder.state == 0 and not decoder.words, "words are left"
    return ids, levels * step @ codec["basis"].astype(float) + codec["mean"]


if __name__ == "__main__":
    ids, tokens = decode(*sys.argv[1:3])
    print(f"{tokens.shape[0]} tokens of width {tokens.shape[1]}, patches {ids[:8]} ..")
    if sys.argv[3:4] == ["--write"]:
        tokens.astype("<f4").tofile(sys.argv[4])
    elif sys.argv[3:4] == ["--check"]:
        error = np.abs(tokens - np.fromfile(sys.argv[4], "<f4").reshape(tokens.shape)).max() / np.abs(tokens).max()
        print(f"largest difference: {error:.1e} of the largest value")
        sys.exit(error > 1e-5)
