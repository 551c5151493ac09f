"""The weights file: one ONNX file that holds a network, its metadata, and a checksum.

Strategy
--------
A file is the serialised ONNX model, followed by two more fields of the same protocol buffer message: our metadata,
and a digest of all before it. Such messages may be concatenated, so any program for ONNX opens the file. For us it
means that metadata can be read without a runtime, that a file which is cut off is told from one that is foreign, and
that a flipped bit does not pass as slightly worse roads.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from probe2road.bounds import NotEmpty, Positive, Probability
from probe2road.errors import InputError, MissingFileError, OptionError
from probe2road.io.atomic import atomic_path
from probe2road.options import checked

__all__ = ["FORMAT", "ModelInfo", "Weights", "network_input", "pack_weights", "read_weights", "replace_info"]

FORMAT = 1  # raised when older versions of probe2road could not use a new file

_INFO, _DIGEST = b"probe2road", b"probe2road.digest"  # keys of our metadata
_METADATA_FIELD = 14  # metadata_props in ONNX's ModelProto: messages of a key (1) and a value (2)
_TEXT = 2  # wire type of length-delimited fields, the only one in metadata
_FIXED_BYTES = {1: 8, 5: 4}  # of the wire types of fixed length
_NOT_OURS = 'use a file that probe2road train has exported, or segmenter="density"'
_COPY = "copy the file again"


@dataclass(frozen=True)
@checked
class ModelInfo:
    """The metadata of a network: its input, its output, and where it comes from."""

    name: str  # of the model, for reports
    channels: Annotated[tuple[str, ...], NotEmpty()]  # names of probe2road.raster.counts.CHANNELS, in its order
    network: dict[str, Any] = field(default_factory=dict)  # what the network is built from, for training
    resolution: Positive[float] = 1.0  # m per pixel
    threshold: Probability = 0.5  # probability that continues a road
    seed_threshold: Probability = 0.5  # probability that starts a road
    tile: Positive[int] = 1024  # px, side of the tiles that the network is made for
    stride: Positive[int] = 32  # px; rows and columns of the input are multiples of this
    training: dict[str, Any] = field(default_factory=dict)  # configuration, seed, steps, data, scores

    def __post_init__(self) -> None:
        """Refuse metadata that no network can have."""
        where = f"model {self.name}"
        if len(set(self.channels)) < len(self.channels):
            raise OptionError(f"channels are {list(self.channels)}", where=where, fix="name each one once")
        if self.tile % self.stride:
            raise OptionError(
                f"a tile of {self.tile} px does not suit a stride of {self.stride} px",
                where=where,
                fix="use a multiple of the stride",
            )
        if self.threshold > self.seed_threshold:
            fault = f"threshold is {self.threshold}, seed_threshold is {self.seed_threshold}"
            raise OptionError(fault, where=where, fix="use threshold <= seed_threshold")


@dataclass(frozen=True)
class Weights:
    """A weights file in memory, checked to be complete and from probe2road."""

    info: ModelInfo
    model: bytes  # the whole file, an ONNX model
    digest: str  # equal for equal networks with equal metadata
    path: Path


def network_input(counts: ArrayLike) -> NDArray[np.float32]:
    """Return the input of networks for counts of any shape: log10(1 + count).

    Notes
    -----
    Paper, section III-A; METHOD 0.1 row 5.

    Examples
    --------
    >>> network_input([0, 9, 99]).round(3)
    array([0., 1., 2.], dtype=float32)
    """
    return np.log10(1.0 + np.asarray(counts, np.float32), dtype=np.float32)


def pack_weights(model: bytes, info: ModelInfo) -> bytes:
    """Return the content of a weights file: a serialised ONNX model and its metadata."""
    text = json.dumps({"format": FORMAT, **asdict(info)}, sort_keys=True)
    data = model + _entry(_INFO, text.encode())
    return data + _entry(_DIGEST, _digest(data).encode())


def replace_info(path: str | Path, info: ModelInfo) -> None:
    """Write other metadata into a weights file; the network in it stays as it is.

    Raises
    ------
    InputError
        If `read_weights` cannot read the file.
    """
    data = read_weights(path).model
    metadata = ((start, content) for number, start, content in _fields(data) if number == _METADATA_FIELD)
    end_of_model = next(start for start, content in metadata if _key_and_value(content)[0] == _INFO)
    with atomic_path(path) as temporary:
        temporary.write_bytes(pack_weights(data[:end_of_model], info))


def read_weights(path: str | Path) -> Weights:
    """Read a weights file and check that it is complete.

    Parameters
    ----------
    path
        Written by `probe2road.segmentation.export_onnx.export`.

    Raises
    ------
    InputError
        If the file cannot be read, is cut off or damaged, is no weights file, or was written by a newer version
        of probe2road in a way that this one does not know.
    """
    path = Path(path)
    try:
        data = path.read_bytes()
    except OSError as error:
        kind = MissingFileError if isinstance(error, FileNotFoundError) else InputError
        raise kind(f"weights cannot be read ({error.strerror})", where=path) from error
    text, digest = _metadata(data, path)
    try:
        table = json.loads(text)
        version = int(table.pop("format"))
    except (ValueError, KeyError, AttributeError, TypeError) as error:
        raise InputError("the metadata of the weights are damaged", where=path, fix=_COPY) from error
    if version > FORMAT:
        raise InputError(
            f"weights of format {version}; this version reads up to {FORMAT}", where=path, fix="update probe2road"
        )
    return Weights(_info(table, path), data, digest, path)


def _info(table: dict[str, Any], path: Path) -> ModelInfo:
    """Return the metadata of a file without the entries that a later version has added to the same format."""
    known = {field.name for field in fields(ModelInfo)}
    try:
        return ModelInfo(
            **{name: value for name, value in table.items() if name in known} | {"channels": tuple(table["channels"])}
        )
    except (KeyError, TypeError, OptionError) as error:
        raise InputError(f"the metadata of the weights make no sense ({error})", where=path, fix=_NOT_OURS) from error


def _metadata(data: bytes, path: Path) -> tuple[bytes, str]:
    """Return our metadata and the digest in a file's content, after a check that it is complete."""
    entries, place = {}, 0
    try:
        for number, start, content in _fields(data):
            if number == _METADATA_FIELD:
                key, value = _key_and_value(content)
                entries[key] = value
            place = start
    except EOFError as error:
        raise InputError("the weights are cut off, or no ONNX file", where=path, fix=_COPY) from error
    except ValueError as error:
        raise InputError("not a weights file", where=path, fix=_NOT_OURS) from error
    if _INFO not in entries:
        raise InputError("not a weights file of probe2road", where=path, fix=_NOT_OURS)
    digest = _digest(data[:place])  # the digest is the last field; it covers everything before it
    if entries.get(_DIGEST) != digest.encode():
        raise InputError("the weights are damaged: their checksum differs", where=path, fix=_COPY)
    return entries[_INFO], digest


def _key_and_value(content: bytes) -> tuple[bytes | None, bytes]:
    """Return what one metadata field holds; the inverse of `_entry`."""
    parts = {number: part for number, _, part in _fields(content)}
    return parts.get(1), parts.get(2, b"")


def _entry(key: bytes, value: bytes) -> bytes:
    """Return one metadata field of an ONNX model."""
    return _field(_METADATA_FIELD, _field(1, key) + _field(2, value))


def _field(number: int, content: bytes) -> bytes:
    """Return one length-delimited field of a protocol buffer message."""
    length, digits = len(content), bytearray([number << 3 | _TEXT])
    while length > 127:
        digits.append(length & 127 | 128)
        length >>= 7
    return bytes(digits) + bytes([length]) + content


def _fields(data: bytes) -> Iterator[tuple[int, int, bytes]]:
    """Yield the fields of a protocol buffer message: number, first byte, content (empty unless length-delimited).

    Raises EOFError where the message ends inside a field, and ValueError where it is no message.
    """
    place = 0
    while place < len(data):
        start = place
        key, place = _varint(data, place)
        wire_type, content = key & 7, b""
        if wire_type == 0:
            _, place = _varint(data, place)
        elif wire_type == _TEXT:
            length, place = _varint(data, place)
            content = data[place : place + length]
            place += length
        elif wire_type in _FIXED_BYTES:
            place += _FIXED_BYTES[wire_type]
        else:
            raise ValueError(f"wire type {wire_type}")
        if place > len(data):
            raise EOFError
        yield key >> 3, start, content


def _varint(data: bytes, place: int) -> tuple[int, int]:
    """Return a number in base 128, lowest digits first, and the position after it."""
    value = shift = 0
    while shift < 64:
        if place >= len(data):
            raise EOFError
        value |= (data[place] & 127) << shift
        place += 1
        if data[place - 1] < 128:
            return value, place
        shift += 7
    raise ValueError("a number of more than 64 bits")


def _digest(data: bytes) -> str:
    return hashlib.blake2b(data, digest_size=16).hexdigest()
