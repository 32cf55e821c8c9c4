"""MCAP (mcap.dev/spec): written chunk by chunk so that a crash costs little, read without its index, torn or whole.

What is written is plain: chunks without compression, schemas and channels before them, an index at the end. What is
read is what was written here; other MCAP files go through the libraries of their makers.
"""

from __future__ import annotations

import errno
import os
import struct
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from ..errors import ScanError
from .reading import COPY_AGAIN, open_regular

MAGIC = b"\x89MCAP0\r\n"
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX = 1, 2, 3, 4, 5, 6, 7, 8
STATISTICS, METADATA, DATA_END = 11, 12, 15
CHUNK_BYTES = 2**20 - 4096  # a chunk with its head stays below 1 MiB, but for a single message that is larger
MAX_CHANNELS = 1000  # of a file that is read: ours have a dozen
MAX_TEXT = 2**20  # bytes of a schema, a channel or a metadata record
MAX_IOV = 512  # pieces of one write: systems allow 1024
_RECORD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_CHUNK = struct.Struct("<QQQI")  # first and last log time, bytes, CRC-32; then compression, bytes again
CHUNK_HEAD = _RECORD.size + _CHUNK.size + 4 + 8  # with no compression


@dataclass(frozen=True, eq=False)
class Message:
    """A message on its way into a file: its channel, when it was logged, ns, its number, its bytes in pieces."""

    channel: int
    log_ns: int
    sequence: int
    pieces: Sequence[bytes | memoryview]

    @property
    def size(self) -> int:
        """Bytes of the message's data."""
        return sum(len(p) for p in self.pieces)


def _text(text: str) -> bytes:
    data = text.encode()
    return struct.pack("<I", len(data)) + data


def _map(entries: Mapping[str, str]) -> bytes:
    return _bytes(b"".join(_text(k) + _text(v) for k, v in entries.items()))


def _bytes(data: bytes) -> bytes:
    return struct.pack("<I", len(data)) + data


def _record(opcode: int, body: bytes) -> bytes:
    return _RECORD.pack(opcode, len(body)) + body


class McapWriter:
    """Writes one file. Nothing is kept that the disk has: a chunk is one write, and is whole or taken back.

    profile, library : of the header. Raises OSError: for the disk; then the file ends with the last whole chunk.
    """

    def __init__(self, path: Path, profile: str, library: str) -> None:
        self._file = os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY | getattr(os, "O_BINARY", 0), 0o666)
        self._end = self._chunk_size = self._messages = self._metadata = 0
        self._chunk: list[Message] = []
        self._described: list[bytes] = []
        self._schemas: dict[str, int] = {}
        self._channels = 0
        self._index: list[bytes] = []
        self._counts: dict[int, int] = {}
        self._refused: dict[int, int] = {}
        self._span = (2**64 - 1, 0)
        self._put([MAGIC, _record(HEADER, _text(profile) + _text(library))])

    @property
    def size(self) -> int:
        """Bytes in the file."""
        return self._end

    @property
    def waiting(self) -> int:
        """Bytes of the chunk that is not yet in the file."""
        return self._chunk_size

    def fileno(self) -> int:
        """The open file, to be flushed to the disk."""
        return self._file

    def channel(self, topic: str, schema: str, definition: str, metadata: Mapping[str, str]) -> int:
        """A channel of ROS 2 messages, written at once; its number."""
        if schema not in self._schemas:
            self._schemas[schema] = len(self._schemas) + 1
            body = struct.pack("<H", self._schemas[schema]) + _text(schema) + _text("ros2msg") + _text(definition)
            self._describe(_record(SCHEMA, body))
        self._channels += 1
        head = struct.pack("<HH", self._channels, self._schemas[schema])
        self._describe(_record(CHANNEL, head + _text(topic) + _text("cdr") + _map(metadata)))
        return self._channels

    def refused(self, channel: int) -> int:
        """Messages of a channel that were given and that the disk did not take; each is told once."""
        return self._refused.pop(channel, 0)

    def metadata(self, name: str, entries: Mapping[str, str]) -> None:
        """A record of names and texts, written at once."""
        self.flush()
        self._put([_record(METADATA, _text(name) + _map(entries))])
        self._metadata += 1

    def write(self, messages: Sequence[Message]) -> None:
        """Messages that belong together: they go into one chunk. Their pieces must not change before `flush`."""
        size = sum(m.size + _RECORD.size + _MESSAGE.size for m in messages)
        if self._chunk and self._chunk_size + size > CHUNK_BYTES:
            self.flush()
        self._chunk += messages
        self._chunk_size += size
        if self._chunk_size > CHUNK_BYTES:
            self.flush()

    def flush(self) -> None:
        """Write the chunk that is open. Raises OSError."""
        if not self._chunk:
            return
        messages, self._chunk = self._chunk, []
        size, self._chunk_size = self._chunk_size, 0
        pieces: list[bytes | memoryview] = []
        crc = at = 0
        offsets: dict[int, list[tuple[int, int]]] = {}
        for m in messages:
            head = _RECORD.pack(MESSAGE, _MESSAGE.size + m.size)
            head += _MESSAGE.pack(m.channel, m.sequence, m.log_ns, m.log_ns)
            offsets.setdefault(m.channel, []).append((m.log_ns, at))
            for piece in (head, *m.pieces):
                crc = zlib.crc32(piece, crc)
                at += len(piece)
            pieces += [head, *m.pieces]
        first, last = min(m.log_ns for m in messages), max(m.log_ns for m in messages)
        chunk = _CHUNK.pack(first, last, size, crc) + _text("") + struct.pack("<Q", size)
        start, length = self._end, CHUNK_HEAD + size
        index, index_at, index_offset = b"", {}, self._end + length
        for channel, entries in offsets.items():
            index_at[channel] = index_offset + len(index)
            table = b"".join(struct.pack("<QQ", *e) for e in entries)
            index += _record(MESSAGE_INDEX, struct.pack("<H", channel) + _bytes(table))
        try:
            self._put([_RECORD.pack(CHUNK, length - _RECORD.size) + chunk, *pieces, index])
        except OSError:
            for channel, entries in offsets.items():
                self._refused[channel] = self._refused.get(channel, 0) + len(entries)
            raise
        where = _bytes(b"".join(struct.pack("<HQ", c, o) for c, o in index_at.items()))
        body = struct.pack("<QQQQ", first, last, start, length) + where + struct.pack("<Q", len(index))
        self._index.append(_record(CHUNK_INDEX, body + _text("") + struct.pack("<QQ", size, size)))
        for channel, entries in offsets.items():
            self._counts[channel] = self._counts.get(channel, 0) + len(entries)
        self._messages += len(messages)
        self._span = (min(first, self._span[0]), max(last, self._span[1]))

    def close(self, complete: bool = True) -> None:
        """The open chunk, the index, the end; complete = False leaves the file as it is. Raises OSError."""
        try:
            if complete:
                self.flush()
                self._finish()
        finally:
            if self._file >= 0:
                os.close(self._file)
            self._file = -1

    def _finish(self) -> None:
        first, last = self._span if self._messages else (0, 0)
        counts = b"".join(struct.pack("<HQ", c, n) for c, n in self._counts.items())
        totals = (self._messages, len(self._schemas), self._channels, 0, self._metadata, len(self._index), first, last)
        statistics = _record(STATISTICS, struct.pack("<QHIIIIQQ", *totals) + _bytes(counts))
        summary = [*self._described, *self._index, statistics]
        end = _record(DATA_END, struct.pack("<I", 0))
        start = self._end + len(end)
        footer = _record(FOOTER, struct.pack("<QQI", start, 0, 0))
        self._put([end, *summary, footer, MAGIC])

    def _describe(self, record: bytes) -> None:
        self.flush()
        self._put([record])
        self._described.append(record)

    def _put(self, pieces: Sequence[bytes | memoryview]) -> None:
        """All the pieces, or none of them: what a full disk took of them is cut off again."""
        queue = [memoryview(p).cast("B") for p in pieces if len(p)]
        total = sum(len(p) for p in queue)
        try:
            while queue:
                done = _write(self._file, queue[:MAX_IOV])
                if done == 0:
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
                while queue and done >= len(queue[0]):
                    done -= len(queue.pop(0))
                if done:
                    queue[0] = queue[0][done:]
        except OSError:
            os.ftruncate(self._file, self._end)
            os.lseek(self._file, self._end, os.SEEK_SET)
            raise
        self._end += total


def _write(file: int, pieces: Sequence[memoryview]) -> int:
    """Bytes written of the pieces; systems without `writev` take one at a time."""
    return os.writev(file, pieces) if hasattr(os, "writev") else os.write(file, pieces[0])


# ---------------------------------------------------------------- reading


@dataclass(frozen=True)
class Channel:
    """A channel of a file that is read."""

    topic: str
    schema: str
    metadata: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class Entry:
    """Where a message lies in the file: its channel, when it was logged, ns, its number, and where its data are."""

    channel: int
    log_ns: int
    sequence: int
    offset: int
    length: int


@dataclass
class McapIndex:
    """What a file holds. complete : it has its end. torn_at : the byte behind the last whole record, where it has none;
    left_over : bytes behind that. cut : the message that the tear went through: its channel, log time, number.
    damaged : where chunks begin that could not be read to their end."""

    path: Path
    library: str = ""
    channels: dict[int, Channel] = field(default_factory=dict)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    messages: list[Entry] = field(default_factory=list)
    complete: bool = False
    torn_at: int = 0
    left_over: int = 0
    cut: tuple[int, int, int] | None = None
    damaged: list[int] = field(default_factory=list)
    schemas: dict[int, str] = field(default_factory=dict)
    whole: tuple[int, int] = (len(MAGIC), 0)  # behind the last whole record of the file itself: byte, messages


def read_mcap_head(data: bytes) -> str | None:
    """The library's name in the header of a file's first bytes; None where it is no MCAP."""
    if not data.startswith(MAGIC) or len(data) < len(MAGIC) + _RECORD.size:
        return None
    opcode, length = _RECORD.unpack_from(data, len(MAGIC))
    at = len(MAGIC) + _RECORD.size
    try:
        fields = _Fields(data[at : at + min(length, MAX_TEXT)])
        fields.text()
        return fields.text() if opcode == HEADER else None
    except _MalformedError:
        return None


def scan_mcap(path: Path, before: McapIndex | None = None) -> McapIndex:
    """Walk a file from its start to its end or tear. before : what was found when it was shorter; it is continued.

    Raises ScanError: no MCAP, or compressed by another program.
    """
    with open_regular(path, "recording", limit_bytes=None) as f:
        size = f.seek(0, os.SEEK_END)
        index = before or McapIndex(path)
        del index.messages[index.whole[1] :]
        index.cut = None
        f.seek(0)
        library = read_mcap_head(f.read(4096))
        if library is None:
            raise ScanError("it is no MCAP recording, or its head is damaged", place=path, hint=COPY_AGAIN)
        index.library = library
        walk = _Walk(f, size, index)
        walk.run(index.whole[0])
        index.torn_at = walk.good
        index.left_over = 0 if index.complete else size - walk.good
    return index


class _MalformedError(Exception):
    pass


class _Fields:
    """Fields of a record, one after another."""

    def __init__(self, data: bytes) -> None:
        self._data, self._at = data, 0

    def numbers(self, form: str) -> tuple:
        try:
            found = struct.unpack_from(form, self._data, self._at)
        except struct.error:
            raise _MalformedError from None
        self._at += struct.calcsize(form)
        return found

    def raw(self) -> bytes:
        (length,) = self.numbers("<I")
        if self._at + length > len(self._data):
            raise _MalformedError
        self._at += length
        return self._data[self._at - length : self._at]

    def text(self) -> str:
        return self.raw().decode("utf-8", "replace")

    def map(self) -> dict[str, str]:
        inner, found = _Fields(self.raw()), {}
        while inner._at < len(inner._data):
            key = inner.text()
            found[key] = inner.text()
        return found


class _Walk:
    """One walk over a file: `good` is the byte behind the last whole record."""

    def __init__(self, file: BinaryIO, size: int, index: McapIndex) -> None:
        self._file, self._size, self._index = file, size, index
        self._schemas = index.schemas
        self.good = 0

    def run(self, at: int) -> None:
        self.good = at
        while not self._index.complete:
            head = self._read(_RECORD.size, at)
            if len(head) < _RECORD.size:
                return
            opcode, length = _RECORD.unpack(head)
            if opcode == 0 or opcode > 0x7F:
                return
            body, end = at + _RECORD.size, at + _RECORD.size + length
            try:
                if opcode == CHUNK:
                    self._chunk(body, min(end, self._size))
                elif end <= self._size:
                    self._plain(opcode, body, length)
            except _MalformedError:
                if opcode != CHUNK or end > self._size:
                    return
                self._index.damaged.append(at)
            if end > self._size:
                return
            at = self.good = end
            self._index.whole = end, len(self._index.messages)

    def _read(self, length: int, at: int) -> bytes:
        self._file.seek(at)
        return self._file.read(length)

    def _plain(self, opcode: int, at: int, length: int) -> None:
        if opcode == FOOTER:
            self._index.complete = self._read(len(MAGIC), at + length) == MAGIC
        if opcode not in (SCHEMA, CHANNEL, METADATA):
            return
        if length > MAX_TEXT or len(self._index.channels) > MAX_CHANNELS:
            raise _MalformedError
        fields = _Fields(self._read(length, at))
        if opcode == SCHEMA:
            (number,) = fields.numbers("<H")
            self._schemas[number] = fields.text()
        elif opcode == CHANNEL:
            number, schema = fields.numbers("<HH")
            topic, _ = fields.text(), fields.text()
            self._index.channels[number] = Channel(topic, self._schemas.get(schema, ""), fields.map())
        else:
            name = fields.text()
            self._index.metadata[name] = fields.map()

    def _chunk(self, at: int, end: int) -> None:
        """The messages of a chunk that ends, or whose file ends, at `end`."""
        head = self._read(CHUNK_HEAD - _RECORD.size, at)
        if len(head) < CHUNK_HEAD - _RECORD.size:
            raise _MalformedError
        if head[_CHUNK.size : _CHUNK.size + 4] != bytes(4):
            raise ScanError("its chunks are compressed", place=self._index.path, hint="read it with --format ros")
        for opcode, body, length in self._inside(at + len(head), end):
            if opcode != MESSAGE:
                continue
            if length < _MESSAGE.size:
                raise _MalformedError
            fixed = self._read(min(_MESSAGE.size, end - body), body)
            if len(fixed) < _MESSAGE.size:
                return
            channel, sequence, log_ns, _ = _MESSAGE.unpack(fixed)
            if body + length > end:
                if end < self._size:
                    raise _MalformedError
                self._index.cut = channel, log_ns, sequence
                return
            entry = Entry(channel, log_ns, sequence, body + _MESSAGE.size, length - _MESSAGE.size)
            self._index.messages.append(entry)
            self.good = body + length

    def _inside(self, at: int, end: int) -> Iterator[tuple[int, int, int]]:
        while at + _RECORD.size <= end:
            opcode, length = _RECORD.unpack(self._read(_RECORD.size, at))
            if opcode == 0:  # a disk that had no time to write what it had made room for
                raise _MalformedError
            yield opcode, at + _RECORD.size, length
            at += _RECORD.size + length
