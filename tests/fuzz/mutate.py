"""Changing valid inputs: bytes and numbers anywhere, and, where a checksum would stop them at the door, behind it."""

from __future__ import annotations

import io
import json
import re
import struct
import zipfile
import zlib
from random import Random
from typing import Any

NUMBER = re.compile(rb"-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
NUMBERS = [b"0", b"-1", b"1e308", b"-1e308", b"1e-308", b"1e999", b"NaN", b"-Infinity", b"255", b"65535", b"65536",
           b"2147483648", b"4294967295", b"9223372036854775808", b"18446744073709551616", b"1" * 30, b"9" * 5000,
           b"0.5", b"1_0", b"0x10", b"", b"x", b"\xff", b"-0.0", b"1e5", b"null"]  # fmt: skip
VALUES: list[Any] = [None, True, 0, -1, 1e308, -1e308, 1e-308, 2**31, 2**63, 10**30, 0.5, "", "x", "\x1b[31m", "\ud800",
                     "end_header\n", "9" * 5000, [], {}, [[]], [0], [0] * 1000, {"": 0}, [[0, 0, 0]] * 3]  # fmt: skip
WORDS = [b"\0", b"\n", b"\r", b'"', b",", b"\xff\xfe", b"\xef\xbb\xbf", b"#", b"[" * 3000, b"{" * 200, b"(" * 300,
         b" " * 4000, b"\n" * 300, b"../", b"/", b"end_header\n", b"\x1b[2J", b"%n", b"\xed\xa0\x80", b"="]  # fmt: skip
EDGES = (0, 1, 0x7F, 0x80, 0xFF)
PNG = b"\x89PNG\r\n\x1a\n"


def mutated(name: str, data: bytes, others: list[bytes], random: Random) -> bytes:
    """A changed input. name : of the seed's file. others : seeds of the same reader, to mix with."""
    if data.startswith(b"PK") and random.random() < 0.7:
        return _member(data, others, random)
    if name.endswith(".json") and random.random() < 0.5:
        return _tree(data, random)
    out = data
    for _ in range(random.choice((1, 1, 1, 2, 3, 6))):
        out = random.choice(MUTATORS)(out, others, random)
    if data.startswith(PNG) and random.random() < 0.5:
        out = _checksums(out)
    return out


def _place(data: bytes, random: Random) -> int:
    """Anywhere; more often in the head, where structure lies."""
    end = len(data) if random.random() < 0.4 else min(len(data), random.choice((64, 512, 4096)))
    return random.randrange(end) if end else 0


def _byte(data: bytes, others: list[bytes], random: Random) -> bytes:
    at = _place(data, random)
    value = random.choice(EDGES) if random.random() < 0.5 else random.randrange(256)
    return data[:at] + bytes([value]) + data[at + 1 :]


def _bit(data: bytes, others: list[bytes], random: Random) -> bytes:
    at = _place(data, random)
    return data[:at] + bytes([data[at] ^ 1 << random.randrange(8)]) + data[at + 1 :] if data else data


def _word(data: bytes, others: list[bytes], random: Random) -> bytes:
    """Two, four or eight bytes at once: sizes, offsets, counts."""
    at, form = _place(data, random), random.choice(("<H", ">H", "<I", ">I", "<Q", "<f", "<d"))
    size = struct.calcsize(form)
    wholes = (0, 1, 2 ** (8 * size) - 1, 2 ** (8 * size - 1), random.randrange(2 ** (8 * size)))
    floats = (float("nan"), 1e300 if size == 8 else 1e38, -1.0)
    word = struct.pack(form, random.choice(floats if form[1] in "fd" else wholes))
    return data[:at] + word + data[at + size :]


def _cut(data: bytes, others: list[bytes], random: Random) -> bytes:
    return data[: random.randrange(len(data) + 1)]


def _drop(data: bytes, others: list[bytes], random: Random) -> bytes:
    at = _place(data, random)
    return data[:at] + data[at + random.choice((1, 2, 8, 64, 1000)) :]


def _again(data: bytes, others: list[bytes], random: Random) -> bytes:
    at = _place(data, random)
    return data[:at] + data[at : at + random.choice((1, 8, 64, 1000))] * random.choice((2, 3, 50)) + data[at:]


def _insert(data: bytes, others: list[bytes], random: Random) -> bytes:
    at = _place(data, random)
    return data[:at] + random.choice(WORDS) + data[at:]


def _number(data: bytes, others: list[bytes], random: Random) -> bytes:
    found = list(NUMBER.finditer(data[:20_000]))
    if not found:
        return _byte(data, others, random)
    hit = random.choice(found)
    return data[: hit.start()] + random.choice(NUMBERS) + data[hit.end() :]


def _line(data: bytes, others: list[bytes], random: Random) -> bytes:
    lines = data.split(b"\n")
    if len(lines) < 2 or len(lines) > 10_000:
        return _again(data, others, random)
    a, b = random.randrange(len(lines)), random.randrange(len(lines))
    how = random.randrange(3)
    if how == 0:
        lines[a], lines[b] = lines[b], lines[a]
    elif how == 1:
        lines.insert(a, lines[b])
    else:
        del lines[a]
    return b"\n".join(lines)


def _mix(data: bytes, others: list[bytes], random: Random) -> bytes:
    other = random.choice(others)
    return data[: _place(data, random)] + other[_place(other, random) :]


MUTATORS = (_byte, _bit, _word, _word, _cut, _drop, _again, _insert, _number, _number, _number, _line, _mix)


def _tree(data: bytes, random: Random) -> bytes:
    """A JSON document with one node exchanged, lost, or a key doubled."""
    tree = json.loads(data)
    nodes: list[tuple[Any, Any]] = []
    level = [tree]
    while level:
        node = level.pop()
        keys = list(node) if isinstance(node, dict) else range(len(node)) if isinstance(node, list) else []
        nodes += [(node, k) for k in keys]
        level += [node[k] for k in keys]
    if not nodes:
        return json.dumps(random.choice(VALUES)).encode()
    owner, key = random.choice(nodes)
    if random.random() < 0.1:
        del owner[key]
    elif random.random() < 0.15:
        owner[key] = [owner[key]]
    elif random.random() < 0.1 and isinstance(owner, dict):
        owner[random.choice(("", "x", "\x1b]0;t\x07", "\ud800", "y" * 5000))] = owner.pop(key)
    else:
        owner[key] = random.choice(VALUES)
    text = json.dumps(tree, ensure_ascii=random.random() < 0.5)
    return text.encode("utf-8", "surrogatepass")


def _member(data: bytes, others: list[bytes], random: Random) -> bytes:
    """A zip archive with one member changed and its checksum right."""
    with zipfile.ZipFile(io.BytesIO(data)) as z:
        members = {name: z.read(name) for name in z.namelist()}
    name = random.choice(list(members))
    how = random.random()
    if how < 0.1:
        del members[name]
    elif how < 0.2:
        members[name] = members[random.choice(list(members))]
    elif name.startswith("__") and how < 0.6:  # the tree itself, its header made to fit
        body = _tree(members[name][128:], random) if how < 0.5 else _number(members[name][128:], others, random)
        head = b"{'descr': '|u1', 'fortran_order': False, 'shape': (%d,), }" % len(body)
        members[name] = b"\x93NUMPY\x01\x00\x76\x00" + head.ljust(117) + b"\n" + body
    else:
        members[name] = random.choice(MUTATORS)(members[name], others, random)
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as z:
        for key, value in members.items():
            z.writestr(key, value)
    return out.getvalue()


def _checksums(data: bytes) -> bytes:
    """A PNG with the checksums its chunks should have."""
    out, at = bytearray(data), len(PNG)
    while at + 12 <= len(out):
        end = at + 12 + int.from_bytes(out[at : at + 4], "big")
        if end > len(out):
            break
        out[end - 4 : end] = zlib.crc32(bytes(out[at + 4 : end - 4])).to_bytes(4, "big")
        at = end
    return bytes(out)
