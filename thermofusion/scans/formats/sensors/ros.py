"""ROS 1 and ROS 2 bags (db3, MCAP) through `rosbags` (Apache-2.0): depth, colour, thermal, camera_info, tf_static.

A stream is a topic of sensor_msgs/Image or CompressedImage; its camera is the camera_info beside it (REP 104), its unit
its encoding (REP 118: 16UC1 millimetres, 32FC1 metres), its place on the rig the static transforms between frames.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Lock
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ....errors import ScanError
from ....files.reading import COPY_AGAIN, decode_image, open_regular
from ....geometry.rigid import invert, pose
from ....types import Camera, Float, Scan, Stream, ThermalCamera
from ...common import Kind, as_loaded, as_thermal, make_camera, make_rig, make_stream
from ...stated import NOTHING, Stated
from ..images import FLOAT_UNIT_M, DepthLayout

MAGIC = b"#ROSBAG V2.0"
REALSENSE = b"/device_"  # topics of the RealSense recorder, which Open3D reads
THERMAL_WORDS = ("thermal", "lepton", "boson", "flir", "optris", "lwir", "infratec")
COLOR_ENCODINGS = {"rgb8": None, "bgr8": cv2.COLOR_BGR2RGB, "rgba8": cv2.COLOR_RGBA2RGB, "bgra8": cv2.COLOR_BGRA2RGB}
COLOR_ENCODINGS |= {"mono8": cv2.COLOR_GRAY2RGB}
DEPTH_ENCODINGS = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}
PACKED_HEAD, PNG = 12, b"\x89PNG"  # of compressedDepth
_ONE_AT_A_TIME = Lock()  # frames are asked for from several threads, and a bag has one place to read at
HINT = "pip install 'thermofusion[ros]'"


@dataclass(frozen=True, eq=False)
class _Topic:
    """A topic of images: log_ns (N,) when each was recorded, stamps_s (N,) when it was taken; its frame."""

    name: str
    connection: Any
    encoding: str
    frame: str
    log_ns: list[int]
    stamps_s: Float


def recognise(path: Path) -> bool:
    """A .bag that is not the RealSense recorder's, a folder with metadata.yaml and .db3 or .mcap, or such a file."""
    if path.is_dir():
        return _bag_of(path) is not None
    if path.suffix.lower() in (".db3", ".mcap"):
        return path.is_file()
    return path.suffix.lower() == ".bag" and path.is_file() and _other_bag(path)


def _bag_of(folder: Path) -> Path | None:
    """What to open in a folder: the folder itself for ROS 2, its only .bag for ROS 1."""
    files = [f for s in ("*.db3", "*.mcap") for f in folder.glob(s)]
    if (folder / "metadata.yaml").is_file() and files:
        return folder
    bags = list(folder.glob("*.bag"))
    return bags[0] if len(bags) == 1 and _other_bag(bags[0]) else None


def _other_bag(path: Path) -> bool:
    """Whether a .bag is no RealSense recording, by the topics of its index; False where it has no index."""
    with open_regular(path, limit_bytes=None) as f:
        head = f.read(4096)
        at = head.find(b"index_pos=")
        if head[: len(MAGIC)] != MAGIC or at < 0 or len(head) < at + 18:
            return False
        index = struct.unpack_from("<Q", head, at + 10)[0]
        if not 0 < index < path.stat().st_size:
            return False
        f.seek(index)
        return REALSENSE not in f.read(2**20)


def read(path: Path, stated: Stated = NOTHING) -> Scan:
    """A bag as a scan; images are read from it when asked for. Raises ScanError."""
    target = (_bag_of(path) or path) if path.is_dir() else path
    reader = _open(target)
    infos, static = _cameras(reader), _static(reader)
    topics = [t for c in reader.connections if c.msgtype.endswith("Image") and (t := _topic(reader, c)) is not None]
    kinds = {kind: [t for t in topics if _kind(t) == kind] for kind in ("depth", "color", "thermal")}
    chosen = {kind: next((t for t in own if _info(infos, t.name)), own[0]) for kind, own in kinds.items() if own}
    if "depth" not in chosen:
        seen = ", ".join(f"{t.name} ({t.encoding})" for t in topics) or "none"
        raise ScanError(f"the bag has no depth images (16UC1 or 32FC1); its images: {seen}", place=path)
    depth = chosen["depth"]
    camera = stated.camera("depth") or _camera(infos, depth, path)
    metres = depth.encoding == "32FC1"
    layout = DepthLayout(stated.unit_m(1.0 if metres else 0.001), stored_unit_m=FLOAT_UNIT_M if metres else 0.001)
    load = _loader(reader, depth, path)
    places = [f"{path}, {depth.name} {i}" for i in range(len(depth.log_ns))]
    scan = Scan(
        name=path.resolve().stem,
        root=path,
        format="ros",
        rig=make_rig(camera, place=path),
        depth=make_stream(
            depth.stamps_s, lambda i: layout.metres(load(i), places[i]), places, place=path, kind="depth"
        ),
        depth_unit_m=FLOAT_UNIT_M if metres else layout.unit_m,
        notes=(f"depth is {depth.name} ({depth.encoding})", *_unused(kinds, chosen)),
    )
    if "color" in chosen:
        scan = _with_color(scan, chosen["color"], depth, reader, infos, static, stated)
    return _with_thermal(scan, chosen["thermal"], depth, reader, infos, static, stated) if "thermal" in chosen else scan


def _open(path: Path) -> Any:
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise ScanError("ROS bags are read through `rosbags`, which is not installed", place=path, hint=HINT) from None
    try:
        reader = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
        reader.open()
    except Exception as e:  # YAML's, sqlite's, mcap's, rosbags' own
        text = str(e).splitlines()[0] if str(e) else type(e).__name__
        raise ScanError(f"the bag cannot be opened ({text})", place=path, hint=COPY_AGAIN) from None
    return reader


def _messages(reader: Any, connection: Any, **span: int) -> Iterator[tuple[int, Any]]:
    """(log time in ns, message) of a topic. What the libraries say of a damaged bag becomes a ScanError."""
    found = reader.messages(connections=[connection], **span)
    while True:
        try:
            _, at, raw = next(found)
            message = reader.deserialize(raw, connection.msgtype)
        except StopIteration:
            return
        except Exception as e:  # sqlite's, mcap's, rosbags' own
            text = f"the bag is damaged at {connection.topic} ({type(e).__name__})"
            raise ScanError(text, place=reader.paths[0], hint=COPY_AGAIN) from None
        yield at, message


def _topic(reader: Any, connection: Any) -> _Topic | None:
    """The topic's times and encoding; None for an empty one. Messages without a stamp of their own take the log's."""
    log, stamps, first = [], [], None
    for at, message in _messages(reader, connection):
        first = first or message
        stamp = message.header.stamp
        stamps.append((stamp.sec, stamp.nanosec) if stamp.sec or stamp.nanosec else divmod(at, 10**9))
        log.append(at)
    if first is None:
        return None
    order = sorted({s: i for i, s in reversed(list(enumerate(stamps)))}.items())  # each time once
    rows = [i for _, i in order]
    seconds = np.array([s + ns * 1e-9 for (s, ns), _ in order])
    encoding = getattr(first, "encoding", None) or _packed(first.format)
    return _Topic(connection.topic, connection, encoding, first.header.frame_id, [log[i] for i in rows], seconds)


def _packed(format: str) -> str:
    """The encoding of a compressed topic: of depth what its packed image holds, e.g. `16UC1; compressedDepth png`."""
    inside = format.split(";")[0].strip()
    return inside if "compressedDepth" in format and inside in DEPTH_ENCODINGS else f"compressed {format}"


def _kind(topic: _Topic) -> Kind | None:
    name = topic.name.lower()
    if any(w in name for w in THERMAL_WORDS) and topic.encoding in DEPTH_ENCODINGS:
        return "thermal"
    if topic.encoding in ("16UC1", "32FC1") or (topic.encoding == "mono16" and "depth" in name):
        return "depth"
    if topic.encoding in COLOR_ENCODINGS or ("jpeg" in topic.encoding and "depth" not in name):
        return "color" if not any(w in name for w in (*THERMAL_WORDS, "infra", "/ir/")) else None
    return None


def _unused(kinds: dict[str, list[_Topic]], chosen: dict[str, _Topic]) -> list[str]:
    left = [t.name for own in kinds.values() for t in own if t not in chosen.values()]
    return [f"image topics that are not used: {', '.join(left)}"] if left else []


def _loader(reader: Any, topic: _Topic, path: Path) -> Callable[[int], NDArray]:
    """i -> the message's image (H, W) or (H, W, C)."""

    def load(i: int) -> NDArray:
        at = topic.log_ns[i]
        with _ONE_AT_A_TIME:
            found = [m for _, m in _messages(reader, topic.connection, start=at, stop=at + 1)]
        if found:
            return _image(found[0], f"{path}, {topic.name} {i}")
        raise ScanError(f"image {i} of {topic.name} cannot be found again", place=path)

    return load


def _image(message: Any, place: object) -> NDArray:
    data = bytes(message.data)
    if not hasattr(message, "encoding"):
        if "compressedDepth" in message.format:
            return _unpacked(data, message.format, place)
        return as_loaded("color", decode_image(data, shape=None, kind="color", place=place), place, 1.0)
    h, w, step = message.height, message.width, message.step
    kind = DEPTH_ENCODINGS.get(message.encoding, "u1")
    channels = {"rgb8": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4}.get(message.encoding, 1)
    row = w * channels * int(kind[1])
    if step < row or len(data) < step * h or not w or not h:
        raise ScanError(f"the image has {len(data)} bytes for {w} x {h} px", place=place, hint=COPY_AGAIN)
    rows = np.frombuffer(data, np.uint8, step * h).reshape(h, step)[:, :row]
    pixels = np.ascontiguousarray(rows).view(f"{'>' if message.is_bigendian else '<'}{kind}")
    image = pixels.astype(kind).reshape((h, w, channels) if channels > 1 else (h, w))
    code = COLOR_ENCODINGS.get(message.encoding)
    return image if code is None else np.asarray(cv2.cvtColor(image, code))


def _unpacked(data: bytes, format: str, place: object) -> NDArray:
    """(H, W) of ROS's compressedDepth: 12 bytes (a number, two floats A and B), then a 16-bit PNG.

    16UC1 is the PNG itself; 32FC1 is A / (value - B) metres, 0 = none.
    """
    if not data[PACKED_HEAD:].startswith(PNG):
        hint = "play the bag into one with raw depth images (image_transport republish)"
        raise ScanError(f"depth packed as '{format}' is not read, PNG alone is", place=place, hint=hint)
    values = decode_image(data[PACKED_HEAD:], shape=None, kind="depth", place=place)
    if values.dtype != np.uint16 or values.ndim != 2:
        raise ScanError(f"packed depth is {values.dtype}, expected 16 bits and one channel", place=place)
    if not format.startswith("32FC1"):
        return values
    A, B = np.frombuffer(data, "<f4", 2, 4)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(values > 0, A / (values.astype(np.float32) - B), np.nan).astype(np.float32)


# ---------------------------------------------------------------- cameras and their places


def _cameras(reader: Any) -> dict[str, Any]:
    """The first camera_info of each namespace."""
    found: dict[str, Any] = {}
    for c in reader.connections:
        if c.msgtype.endswith("CameraInfo"):
            for _, message in _messages(reader, c):
                found[c.topic.rsplit("/", 1)[0]] = message
                break
    return found


def _info(infos: dict[str, Any], topic: str) -> Any:
    """The camera_info in the topic's namespace, or in the one above (image_raw/compressed)."""
    space = topic.rsplit("/", 1)[0]
    return infos.get(space) or infos.get(space.rsplit("/", 1)[0])


def _camera(infos: dict[str, Any], topic: _Topic, path: Path) -> Camera:
    info = _info(infos, topic.name)
    if info is None:
        hint = "put a rig.json with its camera beside the bag"
        raise ScanError(f"there is no camera_info beside {topic.name}", place=path, hint=hint)
    K = np.array(getattr(info, "K", getattr(info, "k", None)), np.float64).reshape(3, 3)
    D = np.array(getattr(info, "D", getattr(info, "d", None)), np.float64).ravel()
    if info.distortion_model not in ("", "plumb_bob", "rational_polynomial", "inverse_brown_conrady") and np.any(D):
        raise ScanError(f"the distortion model '{info.distortion_model}' of {topic.name} is not read", place=path)
    if info.distortion_model == "inverse_brown_conrady":
        D = D[:0]  # RealSense depth: zeros in the field, and no model of OpenCV's
    return make_camera(info.width, info.height, K, D[:8] if len(D) >= 8 else D[:5], place=f"{path}, {topic.name}")


def _static(reader: Any) -> dict[tuple[str, str], Float]:
    """(parent, child) -> T_parent_child (4, 4) m of the static transforms."""
    found: dict[tuple[str, str], Float] = {}
    for c in reader.connections:
        if c.topic.endswith("tf_static"):
            for _, message in _messages(reader, c):
                for t in message.transforms:
                    p, q = t.transform.translation, t.transform.rotation
                    R = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
                    ends = (t.header.frame_id.strip("/"), t.child_frame_id.strip("/"))
                    found[ends] = pose(R, np.array([p.x, p.y, p.z]))
    return found


def _between(static: dict[tuple[str, str], Float], to: str, of: str) -> Float | None:
    """T_to_of along the tree of static transforms; None where they are not connected."""
    edges = {**{(a, b): T for (a, b), T in static.items()}, **{(b, a): invert(T) for (a, b), T in static.items()}}
    known, todo = {to.strip("/"): np.eye(4)}, [to.strip("/")]
    while todo:
        at = todo.pop()
        for (a, b), T in edges.items():
            if a == at and b not in known:
                known[b] = known[at] @ T
                todo.append(b)
    return known.get(of.strip("/"))


def _with_color(
    scan: Scan, topic: _Topic, depth: _Topic, reader: Any, infos: dict, static: dict, stated: Stated
) -> Scan:
    T = np.eye(4) if topic.frame == depth.frame else _between(static, topic.frame, depth.frame)
    if T is None and (stated.rig is None or stated.rig.extrinsics.T_color_depth is None):
        text = f"colour ({topic.name}) is left out: no static transform from {depth.frame} to {topic.frame}"
        return replace(scan, notes=(*scan.notes, text))
    camera = stated.camera("color") or _camera(infos, topic, scan.root)
    rig = make_rig(scan.rig.depth, camera, np.eye(4) if T is None else T, place=scan.root)
    return replace(scan, rig=rig, color=_stream(reader, topic, "color", scan.root))


def _with_thermal(
    scan: Scan, topic: _Topic, depth: _Topic, reader: Any, infos: dict, static: dict, stated: Stated
) -> Scan:
    group = None if stated.rig is None else stated.rig.cameras.thermal
    own = None if stated.rig is None else stated.rig.extrinsics.T_thermal_depth
    T = _between(static, topic.frame, depth.frame)
    if group is None or group.signal is None or (T is None and own is None):
        text = f"thermal ({topic.name}) is left out: a rig.json with cameras.thermal.signal brings it in"
        if T is None and own is None:
            text += f", and extrinsics.T_thermal_depth: no static transform from {depth.frame} to {topic.frame}"
        return replace(scan, notes=(*scan.notes, text))
    try:
        camera = ThermalCamera(_camera(infos, topic, scan.root), np.array(own) if T is None else T)
    except ValueError as e:
        raise ScanError(str(e), place=stated.rig_path or scan.root) from None
    return replace(scan, thermal=as_thermal(_stream(reader, topic, "thermal", scan.root), camera))


def _stream(reader: Any, topic: _Topic, kind: Kind, path: Path) -> Stream:
    places = [f"{path}, {topic.name} {i}" for i in range(len(topic.log_ns))]
    return make_stream(topic.stamps_s, _loader(reader, topic, path), places, place=path, kind=kind)
