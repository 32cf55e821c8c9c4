"""Small recordings made for tests: a warm box before a wall, and foreign containers written byte by byte."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import cv2
import numpy as np

from thermofusion.geometry.camera import pixel_rays
from thermofusion.geometry.rigid import pose
from thermofusion.scans.common import as_thermal
from thermofusion.types import (
    BlackbodyReference,
    Camera,
    ContactReference,
    Environment,
    Rig,
    Scan,
    SignalCurve,
    Stream,
    ThermalCamera,
    Trajectory,
)

BOX_M, WALL_M = 1.0, 2.0
COEFFICIENTS = (-30.0, 0.0026, 1.1e-8)


def camera(width, height, focal, distortion=(0, 0, 0, 0, 0)):
    K = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1.0]])
    return Camera(width, height, K, np.array(distortion, float))


def box_image(cam, t_x, inside, outside):
    """What a camera displaced by t_x sees of a box of 0.4 x 0.3 m at BOX_M."""
    u = np.arange(cam.width_px)
    v = np.arange(cam.height_px)
    x = (u - cam.K[0, 2]) / cam.K[0, 0] * BOX_M - t_x
    y = (v - cam.K[1, 2]) / cam.K[1, 1] * BOX_M
    hit = (np.abs(x) <= 0.2)[None, :] & (np.abs(y) <= 0.15)[:, None]
    return np.where(hit, inside, outside)


def stream(images, times, usable=None):
    n = len(images)
    flags = np.ones(n, bool) if usable is None else np.array(usable)
    places = tuple(f"memory {i}" for i in range(n))
    return Stream(np.array(times, float), lambda i: images[i], places, np.arange(n), flags)


def tiny_scan(size=(64, 48), frames=4):
    """A whole scan in memory: depth with a hole, colour, counts, poses, references; every field of the format."""
    depth_cam = camera(*size, 60.0 * size[0] / 64)
    color_cam = camera(size[0] + 8, size[1], 60.0 * size[0] / 64, (0.01, -0.02, 0, 0, 0))
    thermal_cam = camera(size[0] - 8, size[1] - 8, 50.0 * size[0] / 64)
    T_color_depth = pose(np.eye(3), np.array([-0.025, 0, 0]))
    T_thermal_depth = pose(np.eye(3), np.array([0.02, 0, 0]))
    rng = np.random.default_rng(7)

    def depth(i):
        raw = box_image(depth_cam, 0.0, BOX_M * 1000 + i, WALL_M * 1000).astype(np.uint16)
        raw[3:5, 3:6] = 0
        metres = raw.astype(np.float32) * np.float32(0.001)
        metres[raw == 0] = np.nan
        return metres

    def color(i):
        grey = box_image(color_cam, -0.025, 200, 60) + rng.integers(0, 20, color_cam.shape)
        return np.repeat(grey[..., None], 3, axis=2).astype(np.uint8)

    def thermal(i):
        return (box_image(thermal_cam, 0.02, 24500, 20500) + rng.integers(0, 30, thermal_cam.shape)).astype(np.uint16)

    times = np.arange(frames) / 15
    T = np.stack([pose(np.eye(3), np.array([0.0, 0, 0.001 * i])) for i in range(frames)])
    n_thermal = max(frames - 1, 1)
    return Scan(
        name="tiny",
        root=Path("memory"),
        format="memory",
        rig=Rig(depth_cam, color_cam, T_color_depth),
        depth=stream([depth(i) for i in range(frames)], times),
        color=stream([color(i) for i in range(frames)], times + 0.004),
        thermal=as_thermal(
            stream(
                [thermal(i) for i in range(n_thermal)],
                times[:n_thermal] + 0.01,
                [i != 1 for i in range(n_thermal)],
            ),
            ThermalCamera(
                thermal_cam,
                T_thermal_depth,
                SignalCurve("counts", "polynomial", {"coefficients_degC": COEFFICIENTS}),
                (8.0, 14.0),
                0.04,
                0.005,
                0.7,
            ),
        ),
        environment=Environment(23.0, 22.5, 45.0),
        references=(
            BlackbodyReference(35.0, 0.03, 0.98, np.array([[1.0, 1], [5, 1], [5, 5]]), (0, 2)),
            ContactReference(33.2, 0.1, np.array([0.1, -0.02, 0.4])),
        ),
        trajectory=Trajectory(times, T),
        recorded_at="2026-05-04T10:31:00+02:00",
        subject={"pseudonym": "S01", "posture": "standing"},
        notes=("made for a test",),
    )


# ---------------------------------------------------------------- Matroska, as k4arecorder writes it


def element(ident, payload, *, unknown=False):
    """One EBML element; `unknown`: with the reserved unknown size."""
    name = ident.to_bytes((ident.bit_length() + 7) // 8, "big")
    size = b"\x01" + b"\xff" * 7 if unknown else (len(payload) | 1 << 56).to_bytes(8, "big")
    return name + size + payload


def number(ident, value):
    return element(ident, value.to_bytes(8, "big"))


def block(track, relative, payload):
    return bytes([0x80 | track]) + struct.pack(">hB", relative, 0) + payload


def track(ident, name, fourcc, width, height):
    info = struct.pack("<IiiHH4sIiiII", 40, width, height, 1, 16, fourcc, 0, 0, 0, 0, 0)
    video = number(0xB0, width) + number(0xBA, height)
    codec = element(0x86, b"V_MS/VFW/FOURCC")
    return element(
        0xAE, number(0xD7, ident) + element(0x536E, name) + codec + element(0x63A2, info) + element(0xE0, video)
    )


def calibration_json(depth_parameters, color_parameters, translation_m=(-0.032, -0.002, 0.004)):
    def entry(location, parameters, sensor, t):
        return {
            "Location": location,
            "Intrinsics": {"ModelParameterCount": 14, "ModelParameters": list(parameters)},
            "Rt": {"Rotation": [1, 0, 0, 0, 1, 0, 0, 0, 1], "Translation": list(t)},
            "SensorWidth": sensor[0],
            "SensorHeight": sensor[1],
        }

    cameras = [
        entry("CALIBRATION_CameraLocationD0", depth_parameters, (1024, 1024), (0, 0, 0)),
        entry("CALIBRATION_CameraLocationPV0", color_parameters, (4096, 3072), translation_m),
    ]
    return json.dumps({"CalibrationInformation": {"Cameras": cameras}}).encode()


def azure_mkv(depth_mm, color_jpeg, times_ms, calibration, *, color_size=(1280, 720), unknown=False, groups=False):
    """A recording: depth (N, H, W) uint16, colour JPEGs; `unknown`: sizes left open, `groups`: BlockGroup."""
    h, w = depth_mm[0].shape
    tracks = track(1, b"COLOR", b"MJPG", *color_size) + track(2, b"DEPTH", b"b16g", w, h)
    clusters = b""
    for d, c, t in zip(depth_mm, color_jpeg, times_ms, strict=True):
        frames = b""
        for payload in (block(1, 0, c), block(2, 1, d.astype(">u2").tobytes())):
            frames += element(0xA0, element(0xA1, payload)) if groups else element(0xA3, payload)
        clusters += element(0x1F43B675, number(0xE7, t) + frames, unknown=unknown)
    attached = element(0x61A7, element(0x466E, b"calibration.json") + element(0x465C, calibration + b"\0"))
    tag = element(0x67C8, element(0x45A3, b"K4A_DEVICE_SERIAL_NUMBER") + element(0x4487, b"000123"))
    body = (
        element(0x1549A966, number(0x2AD7B1, 1_000_000))
        + element(0x1654AE6B, tracks)
        + element(0x1941A469, attached)
        + element(0x1254C367, element(0x7373, tag))
        + clusters
    )
    return element(0x1A45DFA3, element(0x4282, b"matroska")) + element(0x18538067, body, unknown=unknown)


# ---------------------------------------------------------------- FLIR containers


def flir_block(raw, *, png=False, order="<", time_s=1_300_000_000):
    """An FFF container with a raw image and camera parameters."""
    h, w = raw.shape
    camera_record = bytearray(0x400)
    struct.pack_into(order + "H", camera_record, 0, 2)
    values = {
        0x20: 0.95, 0x24: 1.0, 0x28: 293.15, 0x2C: 293.15, 0x30: 293.15, 0x34: 0.96, 0x3C: 0.5,
        0x58: 21106.77, 0x5C: 1501.0, 0x60: 1.0, 0x70: 0.006569, 0x74: 0.01262, 0x78: -0.002276, 0x7C: -0.00667,
        0x80: 1.9, 0x30C: 0.012545258,
    }  # fmt: skip
    for at, value in values.items():
        struct.pack_into(order + "f", camera_record, at, value)
    struct.pack_into(order + "i", camera_record, 0x308, -7340)
    struct.pack_into(order + "II", camera_record, 0x384, time_s, 250)
    pixels = cv2.imencode(".png", raw.byteswap())[1].tobytes() if png else raw.astype(order + "u2").tobytes()
    raw_record = struct.pack(order + "HHH", 2, w, h).ljust(0x20, b"\0") + pixels
    start = 0x40 + 2 * 32
    rows = [(1, start, len(raw_record)), (0x20, start + len(raw_record), len(camera_record))]
    head = b"FFF\0".ljust(0x14, b"\0") + struct.pack(">III", 100, 0x40, 2)
    directory = b"".join(struct.pack(">HHIIII", k, 0, 0, 0, at, n).ljust(32, b"\0") for k, at, n in rows)
    return head.ljust(0x40, b"\0") + directory + raw_record + bytes(camera_record)


def flir_jpeg(container, parts=2):
    """A JPEG that carries the container in APP1 segments."""
    picture = cv2.imencode(".jpg", np.full((8, 8), 128, np.uint8))[1].tobytes()
    step = -(-len(container) // parts)
    segments = b""
    for i in range(parts):
        body = b"FLIR\0\x01" + bytes([i, parts - 1]) + container[i * step : (i + 1) * step]
        segments += b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body
    return picture[:2] + segments + picture[2:]


def write_pnm(image, byteorder=">"):
    """PGM of (H, W) or PPM of (H, W, 3 as B, G, R), uint8 or uint16."""
    h, w = image.shape[:2]
    pixels = image if image.ndim == 2 else image[..., ::-1]
    maxval = 255 if image.dtype == np.uint8 else 65535
    kind = 5 if image.ndim == 2 else 6
    return f"P{kind} {w} {h} {maxval}\n".encode() + pixels.astype(image.dtype.newbyteorder(byteorder)).tobytes()


def backproject(camera, depth_m):
    """Depth image (H, W) in metres along z, NaN = none, to points (H, W, 3) in the camera's frame."""
    rays = pixel_rays(camera)
    return rays * (depth_m / rays[..., 2])[..., None]
