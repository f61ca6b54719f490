"""What a damaged disk, a careless editor or a stranger does to the bytes of a file."""

import random

# What numbers become: not finite, far too large or small, empty, no number, more digits than an integer may have.
NUMBERS = (
    b"nan",
    b"inf",
    b"-inf",
    b"1e400",
    b"-1e300",
    b"1e-320",
    b"0",
    b"-1",
    b"",
    b"9" * 30,
    b"9" * 5000,
    b"true",
    b'"a"',
    b"[]",
    b"null",
    b"0x1f",
    b"\xff",
)
PIECES = (
    b"[",
    b"]",
    b"{",
    b"}",
    b"<",
    b">",
    b"&",
    b'"',
    b"'",
    b":",
    b",",
    b"\n",
    b"\0",
    b"---",
    b"%",
    b"!!",
    b"#",
    b"=",
    b"\xef\xbb\xbf",
    b"[" * 20_000,
)


def mutated(content: bytes, rng: random.Random) -> bytes:
    """The content with one to four things done to it."""
    data = bytearray(content)
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        if len(data) < 2:
            break
        i, j = sorted(rng.sample(range(len(data)), 2))
        kind = rng.randrange(8)
        if kind == 0:
            data[i] ^= 1 << rng.randrange(8)
        elif kind == 1:
            data[i] = rng.randrange(256)
        elif kind == 2:
            del data[i:]
        elif kind == 3:
            data[i:i] = data[i : min(j, i + 2000)]
        elif kind == 4:
            del data[i : min(j, i + 200)]
        elif kind == 5:
            data[i:i] = rng.choice(PIECES)
        else:
            number(data, i, rng)
    return bytes(data)


def number(data: bytearray, start: int, rng: random.Random) -> None:
    """Replace the first number from `start` on."""
    digits = b"0123456789.-+e"
    first = next((k for k in range(start, len(data)) if data[k] in digits[:10]), None)
    if first is not None:
        last = next((k for k in range(first, len(data)) if data[k] not in digits), len(data))
        data[first:last] = rng.choice(NUMBERS)
