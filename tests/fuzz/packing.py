"""Unpacking of formats with compression and checksums, and packing with correct ones."""

from __future__ import annotations

import gzip
import io
import struct
import zipfile
import zlib

import zstandard


def unpack_zip(data: bytes) -> bytes:
    """The members' bytes, each after its name and its length."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        parts = [(name.encode(), archive.read(name)) for name in archive.namelist()]
    return b"".join(struct.pack("<HI", len(name), len(body)) + name + body for name, body in parts)


def pack_zip(data: bytes) -> bytes:
    buffer, at = io.BytesIO(), 0
    with zipfile.ZipFile(buffer, "w") as archive:
        while at + 6 <= len(data) and len(archive.filelist) < 2000:
            name, body = struct.unpack_from("<HI", data, at)
            at += 6
            shown = data[at : at + name % 64].decode("latin-1").replace("\0", "_") or "_"
            archive.writestr(zipfile.ZipInfo(shown), data[at + name : at + name + body])
            at += name + body
    return buffer.getvalue()


def pack_gzip(data: bytes) -> bytes:
    return gzip.compress(data, 1, mtime=0)


def unpack_spz(data: bytes) -> bytes:
    """Of SPZ version 4, the header, and the expanded streams, each after its length."""
    count, (start,) = data[15], struct.unpack_from("<I", data, 16)
    body, at = data[:32], start + 16 * count
    for i in range(count):
        (size,) = struct.unpack_from("<Q", data, start + 16 * i)
        stream = zstandard.decompress(data[at : at + size])
        body, at = body + struct.pack("<I", len(stream)) + stream, at + size
    return body


def pack_spz(data: bytes) -> bytes:
    """The table has the sizes of the streams, and the last stream has what is left."""
    table, streams, at = b"", b"", 32
    last = min(data[15], 6) - 1 if len(data) > 15 else -1
    for i in range(last + 1):
        (size,) = struct.unpack("<I", data[at : at + 4].ljust(4, b"\0"))
        part = data[at + 4 : at + 4 + size if i < last else None]
        at += 4 + size
        packed = zstandard.compress(part, 1)
        table += struct.pack("<QQ", len(packed), len(part))
        streams += packed
    return data[:32] + table + streams


def pack_png(data: bytes) -> bytes:
    """The same chunks with correct checksums."""
    out, at = [data[:8]], 8
    while at + 8 <= len(data):
        end = at + 8 + int.from_bytes(data[at : at + 4], "big")
        body = data[at + 4 : end]
        out += [data[at : at + 4], body, zlib.crc32(body).to_bytes(4, "big")]
        at = end + 4
    return b"".join(out)


def unpack_glb(data: bytes) -> bytes:
    """The JSON chunk and the binary chunk, after the length of the first."""
    (length,) = struct.unpack_from("<I", data, 12)
    return data[12:16] + data[20 : 20 + length] + data[28 + length :]


def pack_glb(data: bytes) -> bytes:
    head = data[:4].ljust(4, b"\0")
    length = struct.unpack("<I", head)[0] % (len(data) + 1)
    text, body = data[4 : 4 + length], data[4 + length :]
    chunks = struct.pack("<I", len(text)) + b"JSON" + text
    chunks += struct.pack("<I", len(body)) + b"BIN\0" + body
    return b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks
