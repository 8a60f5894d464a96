"""Change bytes at random: turned bits, extreme numbers, strange texts, parts that are missing, repeated or moved."""

from __future__ import annotations

from random import Random

# As float32 and int32: infinity, NaN, -1, the largest integer, -0.0.
WORDS = (b"\x00\x00\x80\x7f", b"\x00\x00\xc0\x7f", b"\xff\xff\xff\xff", b"\xff\xff\xff\x7f", b"\x00\x00\x00\x80")
NUMBERS = (b"nan", b"inf", b"-1e308", b"1e400", b"-0", b"9" * 30)
TEXTS = (*NUMBERS, b"", b"\0", b"\xff\xfe", b",,,", b"{}", b"[[", b'"', b"\n")


def flipped(data: bytes, place: int, bit: int) -> bytes:
    """Return the bytes with one bit turned."""
    return data[:place] + bytes([data[place] ^ 1 << bit]) + data[place + 1 :]


def mutated(data: bytes, random: Random) -> bytes:
    """Return the bytes with one to four mutations."""
    out = bytearray(data)
    for _ in range(random.randrange(1, 5)):
        if not out:
            break
        at, what = random.randrange(len(out)), random.randrange(10)
        end = min(len(out), at + random.choice((1, 2, 4, 8, 40, 400)))
        if what == 0:
            out[at] ^= 1 << random.randrange(8)
        elif what == 1:
            out[at] = random.choice((0, 1, 127, 128, 254, 255))
        elif what == 2:
            out[at:end] = random.randbytes(end - at)
        elif what == 3:
            del out[at:end]
        elif what == 4:
            out[at:at] = out[at:end]
        elif what == 5:
            del out[at:]
        elif what == 6:
            size = random.choice((2, 4, 8))
            value = random.choice((0, 1, 2**7, 2**15, 2**31, 2**63, 2**64 - 1)) + random.randrange(-1, 2)
            out[at : at + size] = (value % 2 ** (8 * size)).to_bytes(size, "little")
        elif what == 7:
            out[at:end] = random.choice(TEXTS)
        elif what == 8:
            at -= at % 4
            out[at : at + 4] = random.choice(WORDS)
        else:
            other = random.randrange(len(out))
            out[at:end] = out[other : other + end - at]
    return bytes(out)
