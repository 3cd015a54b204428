"""What strangers may write into a file: mutations of valid ones, by kind of file."""

from __future__ import annotations

import io
import json
import os
import pickle
import random
import re
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

#: Raw JSON in place of a value: what a writer of JSON writes, and what only a person does.
JSON_VALUES = (
    "null", "true", "false", "0", "-1", "1", "-0.0", "0.5", '""', '" "', "[]", "{}", "[[]]",
    "1e308", "-1e308", "5e-324", "1e200", "-1e200", "1e999", "NaN", "Infinity", "-Infinity",
    "9223372036854775807", "9223372036854775808", "4294967296", "100000000", "1" * 5000,
    "-" + "9" * 5000, "1." + "0" * 5000, '"\\ud800"', '"a\\udcffb"', '"\\u0000"', '"\\u001b[2J"',
    '"\\u202egnp.exe"', '"' + "x" * 1_000_000 + '"', '"' + "\\n" * 5000 + '"', '"../../../etc"',
    '"/etc/passwd"', '"=1+1"', '"<script>"', '"nan"', '"1"', '"\\ud83d\\ude00"', "[1,2,3]",
    "[" * 90 + "]" * 90, "[" * 5000 + "]" * 5000, '{"a":' * 300 + "1" + "}" * 300,
    "[" + "0," * 200_000 + "0]", '{"a":1,"a":2}', '{"\\ud800":1}', '{"":null}',
    '{"\\u001b[31m":0}', "[" + '"a",' * 50_000 + '"a"]', "[1e308,1e308]", "[-1,0,1e-300]",
)  # fmt: skip
#: Raw TOML in place of a value.
TOML_VALUES = (
    "0", "-1", "1", "0.5", '""', "[]", "{}", "[[]]", "true", "1e308", "-1e308", "5e-324", "1e200",
    "[0.0, 0.0, 0.0, 0.0, 1e200]", "[1e200, 1e200, 1e200, 1e200, 1e200]", "nan", "inf", "-inf",
    "9223372036854775807", "9223372036854775808", "1" * 5000, "-" + "9" * 5000, "0x" + "f" * 5000,
    '"\\ud800"', '"\\u0000"', '"\\u001b[2J"', '"\\u202e"', '"' + "x" * 200_000 + '"',
    '"../../../etc"', '"mano:/etc"', '"gltf:/etc/passwd"', "1979-05-27", "07:32:00",
    "1979-05-27T07:32:00Z", "[" * 90 + "]" * 90, "[" * 3000 + "]" * 3000,
    "{a = " * 300 + "1" + "}" * 300, "[" + "0," * 50_000 + "]", '{"a" = 1, "a" = 2}', "'''x",
    "[[0.02, 0.17, 5]]", "[[0.0, 1e-300, 5]]", "[1e308, 1e308, 1e308]", "[0, 0, 0]", "1_0_",
)  # fmt: skip
#: What follows `NAME=` in `--set`, and the values of other options.
WORDS = (
    *TOML_VALUES,
    "", "x", "auto", "nan", "inf", "-5", "1e999", "\ud800", "a\udcff", "\x1b[2J", "a\nb", "none",
    "..", "/", "/dev/null", "/dev/zero", "a" * 300, "é", "=", "0:0", "5:2",
    "0:99999999999", "-1:3", "1" * 400,
)  # fmt: skip
#: Names of folders and files that a person may have.
NAMES = (
    b"\xff\xfe", b"a\xe9b", b"a b", b"a\x1b[2Jb", b"a\nb", b"-o", b"a" * 200, "é".encode(), b"%s",
    "\u202egnp".encode(), b"{x}", b"'", b"a\\b", b"#",
)  # fmt: skip

_MARK = "@@fuzzed@@"
_NUMBERS = (
    np.nan, np.inf, -np.inf, 1e308, -1e308, 1e200, 1e38, 1e25, 1e12, 1e6, 5e-324, 0.0, -1.0, 1e-40,
)  # fmt: skip


def mutate(path: Path, chance: random.Random) -> str:
    """Change a file in one or two ways, and say how."""
    kinds: dict[str, Callable[[bytes, random.Random], tuple[bytes, str]]] = {
        ".json": _json, ".toml": _toml, ".npz": _npz, ".safetensors": _safetensors, ".pkl": _pickle,
    }  # fmt: skip
    data = path.read_bytes()
    structured = kinds.get(path.suffix)
    if structured is not None and chance.random() < 0.85:
        changed, how = structured(data, chance)
    elif path.suffix in (".png", ".jpg") and chance.random() < 0.4:
        changed, how = _image(data, chance)
    elif path.suffix in (".avi", ".mp4") and chance.random() < 0.4:
        changed, how = _video(data, chance)
    else:
        changed, how = _bytes(data, chance)
    path.unlink()  # it may be a link to the valid file
    path.write_bytes(changed)
    return f"{path.name}: {how}"


def _bytes(data: bytes, chance: random.Random) -> tuple[bytes, str]:
    place = chance.randrange(len(data) + 1)
    other = chance.randrange(len(data) + 1)
    junk = chance.randbytes(chance.choice((1, 4, 100)))
    ways = {
        "empty": b"",
        f"truncated at {place}": data[:place],
        f"{len(junk)} bytes at {place} replaced": data[:place] + junk + data[place + len(junk) :],
        f"{len(junk)} bytes put in at {place}": data[:place] + junk + data[place:],
        "doubled": data + data,
        f"a part moved to {place}": data[:place] + data[min(place, other) : max(place, other)],
        f"zeros from {place}": data[:place] + bytes(len(data) - place),
        f"ones at {place}": data[:place] + b"\xff" * 8 + data[place + 8 :],
        "a BOM": b"\xef\xbb\xbf" + data,
        "UTF-16": b"\xff\xfe" + data[:1000],
    }
    how = chance.choice(sorted(ways))
    return ways[how], how


def _places(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    found = [path]
    if isinstance(value, dict):
        for key, item in value.items():
            found += _places(item, (*path, key))
    elif isinstance(value, list):
        # A few of a long list: what is at the top must have its turn too.
        for index in {0, len(value) // 2, len(value) - 1} if value else ():
            found += _places(value[index], (*path, index))
    return found


def _json(data: bytes, chance: random.Random) -> tuple[bytes, str]:
    value = {"": json.loads(data)}
    place = chance.choice(_places(value[""]))
    holder, key = value, ""
    for step in place:
        holder, key = holder[key], step
    raw = chance.choice(JSON_VALUES)
    way = chance.choice(("value", "value", "value", "value", "missing", "more", "name", "repeat"))
    name = ".".join(map(str, place)) or "all"
    if way == "missing" and place:
        del holder[key]
    elif way == "more" and isinstance(holder[key], list | dict):
        inner: Any = holder[key]
        if isinstance(inner, dict):
            inner[chance.choice(("extra", "__class__", "\x1b[2J", ""))] = _MARK
        else:
            inner.append(_MARK)
    elif way == "name" and isinstance(holder, dict) and place:
        holder[_MARK] = holder.pop(key)
        raw = chance.choice(('"\\ud800"', '"\\u001b[2J"', '""', '"' + "k" * 100_000 + '"', '"x.y"'))
    elif way == "repeat" and isinstance(holder[key], list) and holder[key]:
        holder[key] = (holder[key] * 100_000)[:100_000]
        raw = ""
    else:
        way = "value"
        holder[key] = _MARK
    text = json.dumps(value[""]).replace(f'"{_MARK}"', raw)
    return text.encode(), f"{way} of {name} {raw[:40]}"


def _toml(data: bytes, chance: random.Random) -> tuple[bytes, str]:
    text = data.decode()
    spots = list(re.finditer(r"(?<== )(\"[^\"]*\"|-?[\d.]+|true|false|\[[^\]\n]*\])", text))
    spot = chance.choice(spots)
    raw = chance.choice(TOML_VALUES)
    line = text.count("\n", 0, spot.start()) + 1
    if chance.random() < 0.15:
        lines = text.splitlines()
        chosen = chance.randrange(len(lines))
        if chance.random() < 0.5:
            return "\n".join(lines[:chosen] + lines[chosen + 1 :]).encode(), f"no line {chosen + 1}"
        doubled = [*lines[:chosen], lines[chosen], *lines[chosen:]]
        return "\n".join(doubled).encode(), f"line {chosen + 1} twice"
    return (text[: spot.start()] + raw + text[spot.end() :]).encode(), f"line {line}: {raw[:40]}"


def _array(array: np.ndarray, chance: random.Random) -> tuple[np.ndarray, str]:
    value = chance.choice(_NUMBERS)
    with np.errstate(all="ignore"):
        ways: dict[str, Callable[[], np.ndarray]] = {
            f"all {value}": lambda: np.full_like(array.astype(np.float64), value),
            f"one {value}": lambda: _with_one(array, value, chance),
            "no rows": lambda: array[:0],
            "a row less": lambda: array[:-1],
            "an axis more": lambda: array[None],
            "flat": lambda: array.ravel(),
            "texts": lambda: np.full(array.shape, "x"),
            "complex": lambda: array.astype(np.complex128),
            "half": lambda: array.astype(np.float16),
            "bytes": lambda: array.astype(np.uint8),
            "huge integers": lambda: np.full(array.shape, 2**63 - 1, dtype=np.int64),
            "a number": lambda: np.array(value),
            "dates": lambda: np.full(array.shape, np.datetime64("2020-01-01")),
        }
        how = chance.choice(sorted(ways))
        try:
            return ways[how](), how
        except (ValueError, TypeError, IndexError):
            return array[..., None], "an axis at the end"


def _with_one(array: np.ndarray, value: float, chance: random.Random) -> np.ndarray:
    changed = array.astype(np.float64)
    changed.reshape(-1)[chance.randrange(changed.size)] = value
    return changed


def _npz(data: bytes, chance: random.Random) -> tuple[bytes, str]:
    with np.load(io.BytesIO(data)) as file:
        arrays = {name: file[name] for name in file.files}
    name = chance.choice(sorted(arrays))
    way = chance.random()
    stream = io.BytesIO()
    if way < 0.75 and arrays[name].size:
        arrays[name], how = _array(arrays[name], chance)
        np.savez(stream, **arrays)
        return stream.getvalue(), f"{name}: {how}"
    if way < 0.85:
        del arrays[name]
        arrays[chance.choice(("extra", "\x1b[2J", "a/../b"))] = np.zeros(3)
        np.savez(stream, **arrays)
        return stream.getvalue(), f"{name} has another name"
    # A header that claims more, or says what numpy's parser of headers does not expect.
    claims = (
        "{'descr': '<f8', 'fortran_order': False, 'shape': (99999999999, 3), }",
        "{'descr': '|O', 'fortran_order': False, 'shape': (3,), }",
        "{'descr': '<f8', 'fortran_order': False, 'shape': (" + "1, " * 70 + "), }",
        "{'descr': [('a', '<f8')], 'fortran_order': False, 'shape': (3,), }",
        "{'descr': '|V0', 'fortran_order': False, 'shape': (99999999999999,), }",
        "{'descr': '<f8', 'fortran_order': False, 'shape': (-3,), }",
        "(" * 4000,
    )
    claim = chance.choice(claims)
    with zipfile.ZipFile(stream, "w") as archive:
        head = claim.encode().ljust(9000) + b"\n"
        archive.writestr(f"{name}.npy", b"\x93NUMPY\x02\x00" + struct.pack("<I", len(head)) + head)
    return stream.getvalue(), f"{name}: {claim[:60]}"


def _safetensors(data: bytes, chance: random.Random) -> tuple[bytes, str]:
    (length,) = struct.unpack("<Q", data[:8])
    head, body = json.loads(data[8 : 8 + length]), bytearray(data[8 + length :])
    name = chance.choice([key for key in sorted(head) if key != "__metadata__"])
    way = chance.choice(("header", "floats", "type", "missing", "more", "length"))
    if way == "header":
        text, how = _json(json.dumps({name: head[name]}).encode(), chance)
        raw = text.strip()
        whole = json.dumps({key: item for key, item in head.items() if key != name})[:-1]
        if raw.startswith(b"{") and len(raw) > 2:
            new = whole.encode() + b"," + raw[1:]
        else:
            new = raw
        return struct.pack("<Q", len(new)) + new + bytes(body), how
    if way == "floats":
        start, stop = head[name]["data_offsets"]
        value = struct.pack("<f", chance.choice((np.nan, np.inf, 1e38, -1e38, 1e-45, 0.0)))
        body[start:stop] = (value * ((stop - start) // 4 + 1))[: stop - start]
        how = f"{name} is all {struct.unpack('<f', value)[0]}"
    elif way == "type":
        head[name]["dtype"] = chance.choice(("I32", "U32", "F16", "BF16", "I64", "BOOL", "F8_E4M3"))
        how = f"{name} is {head[name]['dtype']}"
    elif way == "missing":
        del head[name]
        how = f"{name} is missing"
    elif way == "more":
        head["\x1b[2J"] = {"dtype": "F32", "shape": [2**40, 0], "data_offsets": [0, 0]}
        how = "one more"
    else:
        return struct.pack("<Q", chance.choice((0, 2**63, 2**40, length - 3))) + data[8:], "length"
    new = json.dumps(head).encode()
    return struct.pack("<Q", len(new)) + new + bytes(body), how


class _Call:
    def __reduce__(self) -> Any:
        return (os.getcwd, ())


def _pickle(data: bytes, chance: random.Random) -> tuple[bytes, str]:
    content = pickle.loads(data)  # our own, written a moment ago
    names = sorted(content) if isinstance(content, dict) else []
    name = chance.choice(names) if names else ""
    shared: Any = [0.0] * 10
    for _ in range(12):
        shared = [shared] * 10
    text: Any = "x" * 1000
    for _ in range(9):
        text = (text,) * 10
    ways: dict[str, Any] = {
        "shared lists": shared,
        "shared texts": text,
        "colliding keys": {i * (2**61 - 1): 0 for i in range(30_000)},
        "a call": _Call(),
        "none": None,
        "a number": 5,
        "a huge integer": 10**5000,
        "a text": "\x1b[2J",
        "lists": [[0.0] * 3] * 778,
        "a dictionary": {"x": [1, 2]},
        "nan": np.full((778, 3), np.nan),
        "1e300": np.full((778, 3), 1e300),
        "objects": np.array([None, "x"], dtype=object),
    }
    way = chance.choice([*sorted(ways), "missing", "all"])
    if way == "all" or not names:
        return pickle.dumps(shared, protocol=2), "shared lists alone"
    if way == "missing":
        del content[name]
    else:
        content[name] = ways[way]
    return pickle.dumps(content, protocol=2), f"{name}: {way}"


def _chunk(kind: bytes, content: bytes) -> bytes:
    import zlib

    summed = struct.pack(">I", zlib.crc32(kind + content))
    return struct.pack(">I", len(content)) + kind + content + summed


def _image(data: bytes, chance: random.Random) -> tuple[bytes, str]:
    import zlib

    size = chance.choice(
        ((1, 1), (100_000, 100_000), (2**31 - 1, 1), (0, 0), (31, 32), (8000, 8000))
    )
    depth, kind = chance.choice(((8, 2), (16, 2), (1, 0), (8, 3), (8, 6), (16, 6), (4, 3), (8, 9)))
    head = struct.pack(">II5B", *size, depth, kind, 0, 0, chance.choice((0, 0, 1)))
    if not data.startswith(b"\x89PNG"):
        return _bytes(data, chance)
    ways = {
        f"a head of {size}, {depth} bits, type {kind}": data[:8]
        + _chunk(b"IHDR", head)
        + data[33:],
        "900 texts": data[:33]
        + b"".join(
            _chunk(b"zTXt", b"k%d\0\0" % i + zlib.compress(bytes(200_000))) for i in range(900)
        )
        + data[33:],
        "an animation": data[:33] + _chunk(b"acTL", struct.pack(">II", 5, 0)) + data[33:],
        "a text that steers": data[:33] + _chunk(b"tEXt", b"a\x1b[2J\0\x1b]0;x\x07") + data[33:],
        "a profile": data[:33]
        + _chunk(b"iCCP", b"x\0\0" + zlib.compress(bytes(10**7)))
        + data[33:],
        "a playlist": b"ffconcat version 1.0\nfile /etc/passwd\n",
        "an SVG": b"<svg xmlns='http://www.w3.org/2000/svg'/>",
        "a GIF": b"GIF89a\x01\0\x01\0\0\0\0;",
        "a TIFF": b"II*\0\x08\0\0\0\0\0",
        "an OpenEXR file": b"v/1\x01\x02\0\0\0",
    }
    how = chance.choice(sorted(ways))
    return ways[how], how


def _video(data: bytes, chance: random.Random) -> tuple[bytes, str]:
    ways = {
        "an ffconcat playlist": b"ffconcat version 1.0\nfile seed.avi\nduration 1\n",
        "an HLS playlist": b"#EXTM3U\n#EXTINF:1,\nseed.avi\n#EXT-X-ENDLIST\n",
        "an SDP description": b"v=0\no=- 0 0 IN IP4 127.0.0.1\nm=video 5004 RTP/AVP 96\n",
        "a PNG": b"\x89PNG\r\n\x1a\n" + data[:500],
        "a name of a codec that steers": data.replace(b"MJPG", b"\x1b[2J"),
        "sizes of two billion": data.replace(struct.pack("<II", 64, 64), b"\xff\xff\xff\x7f" * 2),
        "an image sequence's name": b"img%03d.png",
        "Y4M": b"YUV4MPEG2 W64 H64 F30:1\nFRAME\n" + bytes(6144),
    }
    how = chance.choice(sorted(ways))
    return ways[how], how
