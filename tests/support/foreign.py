"""The same three moments, written small as other programs write them: one writer a format."""

from __future__ import annotations

import io
import json
import sqlite3
import struct
import zipfile
import zlib

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from thermofusion.geometry.rigid import se3_exp

N = 3
GL = np.diag([1.0, -1, -1, 1])
BODY_OPTICAL = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
TIMES = np.array([5000.0, 5000.125, 5000.25])  # s
POSES = np.stack([se3_exp(np.array([0.01 * i, 0.1 * i, -0.02 * i, 0.2 * i, 0.03 * i, -0.1 * i])) for i in range(N)])


class Moments:
    """Depth of a tilted plane at a size (width, height); K; colour is grey and says which frame it is."""

    def __init__(self, width=64, height=48):
        self.w, self.h = width, height
        self.K = np.array([[0.9 * width, 0, width / 2 - 0.7], [0, 0.92 * width, height / 2 + 0.4], [0, 0, 1]])

    def mm(self, i):
        v, u = np.mgrid[: self.h, : self.w]
        z = (1000 + 100 * i + np.rint(u * 181 / self.w) + np.rint(v * 97 / self.h)).astype(np.uint16)
        z[0, : 2 + i] = 0
        return z

    def metres(self, i):
        return np.where(self.mm(i) > 0, self.mm(i) / np.float32(1000), np.float32(np.nan)).astype(np.float32)

    def color(self, i, scale=1.0):
        return np.full((int(self.h * scale), int(self.w * scale), 3), 60 + 40 * i, np.uint8)


def put(path, data):
    path.parent.mkdir(parents=True, exist_ok=True)
    if isinstance(data, np.ndarray):
        data = cv2.imencode(path.suffix, data)[1].tobytes()
    elif isinstance(data, dict):
        data = json.dumps(data).encode()
    elif isinstance(data, str):
        data = data.encode()
    path.write_bytes(data)


def rows(times, poses):
    """time x y z qx qy qz qw."""
    q = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    return np.column_stack([times, poses[:, :3, 3], q]).tolist()


def text(table, cut=" "):
    return "".join(cut.join(f"{x:.9f}" for x in r) + "\n" for r in table)


def rig(m, **depth):
    return {"cameras": {"depth": {"width_px": m.w, "height_px": m.h, "K": m.K.tolist(), **depth}}, "extrinsics": {}}


def open3d_json(m, **more):
    return {"width": m.w, "height": m.h, "intrinsic_matrix": m.K.T.ravel().tolist(), **more}


def plain(root, m, depth=None, suffix=".png", color=True, **more):
    for i in range(N):
        put(root / f"depth/{i + 8:d}{suffix}", (depth or Moments.mm)(m, i))  # 8, 9, 10: text order is not number order
        if color:
            put(root / f"color/{i + 8:d}.png", m.color(i))
    put(root / "camera_intrinsic.json", open3d_json(m, **more))
    return root


def redwood(root):
    m = Moments()
    put(root / "trajectory.log", "".join(f"{i} {i} {i + 1}\n{text(POSES[i])}" for i in range(N)))
    return plain(root, m), m


def tum(root):
    m = Moments()
    put(root / "rig.json", rig(m))
    lists = {"depth": [], "rgb": []}
    for i in (2, 0, 1):  # not in their order
        for kind, image in (("depth", m.mm(i) * 5), ("rgb", m.color(i))):
            put(root / f"{kind}/{TIMES[i]:.6f}.png", image)
            lists[kind].append(f"{TIMES[i]:.6f} {kind}\\{TIMES[i]:.6f}.png\n")
    for kind, lines in lists.items():
        put(root / f"{kind}.txt", "# timestamp filename\n" + "".join(lines))
    put(root / "groundtruth.txt", text(rows(TIMES, POSES)))
    return root, m


def sevenscenes(root):
    m = Moments()
    for i in range(N):
        put(root / f"frame-{i:06d}.depth.png", m.mm(i))
        put(root / f"frame-{i:06d}.color.png", m.color(i))
        put(root / f"frame-{i:06d}.pose.txt", text(POSES[i], "\t"))
    put(root / "camera-intrinsics.txt", text(m.K))
    return root, m


def stray(root):
    m = Moments()
    root.mkdir(parents=True)
    for i in range(N):
        put(root / f"depth/{i:06d}.png", m.mm(i))
        put(root / f"confidence/{i:06d}.png", np.where(m.mm(i) > 0, 2, 0).astype(np.uint8))
    K = m.K * [[1.5], [1.5], [1]]
    K[0, 2], K[1, 2] = 1.5 * m.K[0, 2], 1.5 * m.K[1, 2]
    video = cv2.VideoWriter(str(root / "rgb.mp4"), cv2.VideoWriter_fourcc(*"mp4v"), 15, (m.w * 3 // 2, m.h * 3 // 2))
    for i in range(N):
        video.write(m.color(i, 1.5))
    video.release()
    put(root / "camera_matrix.csv", text(K, ", "))
    table = [[t, i, *r] for i, (t, *r) in enumerate(rows(TIMES, POSES))]
    put(root / "odometry.csv", "timestamp, frame, x, y, z, qx, qy, qz, qw\n" + text(table, ", "))
    return root, m


def record3d(root):
    m = Moments()
    root.mkdir(parents=True)
    poses = [[*r[4:], *r[1:4]] for r in rows(TIMES, POSES @ GL)]
    K = m.K * [[1.5], [1.5], [1]]
    meta = {"w": m.w * 3 // 2, "h": m.h * 3 // 2, "dw": m.w, "dh": m.h, "fps": 8, "K": K.T.ravel().tolist()}
    meta |= {"poses": poses, "frameTimestamps": TIMES.tolist()}
    with zipfile.ZipFile(root / "recording.r3d", "w") as z:
        z.writestr("metadata", json.dumps(meta))
        for i in range(N):
            z.writestr(f"rgbd/{i}.jpg", cv2.imencode(".jpg", m.color(i, 1.5))[1].tobytes())
            for name, data in (("depth", m.metres(i).tobytes()), ("conf", bytes([2]) * (m.w * m.h))):
                z.writestr(f"rgbd/{i}.{name}", b"bvx-" + struct.pack("<I", len(data)) + data + b"bvx$")
    return root / "recording.r3d", m


def polycam(root):
    m = Moments()
    K = m.K * [[1.5], [1.5], [1]]
    for i in range(N):
        name = f"{round(TIMES[i] * 1e6)}"
        T = POSES[i] @ GL
        camera = {
            "fx": K[0, 0],
            "fy": K[1, 1],
            "cx": K[0, 2],
            "cy": K[1, 2],
            "width": m.w * 3 // 2,
            "height": m.h * 3 // 2,
        }
        camera |= {f"t_{r}{c}": T[r, c] for r in range(3) for c in range(4)}
        put(root / f"keyframes/corrected_cameras/{name}.json", camera)
        put(root / f"keyframes/cameras/{name}.json", camera | {"t_03": 9.0})  # before the optimisation: not to be used
        put(root / f"keyframes/corrected_images/{name}.jpg", m.color(i, 1.5))
        put(root / f"keyframes/depth/{name}.png", m.mm(i))
    return root, m


def rtabmap(root):
    m = Moments()
    root.mkdir(parents=True)
    base = sqlite3.connect(root / "map.db")
    base.executescript(
        "CREATE TABLE Node (id INTEGER, stamp FLOAT, pose BLOB);"
        "CREATE TABLE Data (id INTEGER, image BLOB, depth BLOB, calibration BLOB);"
    )
    P = np.hstack([m.K, np.zeros((3, 1))])
    blob = struct.pack("<11i", 0, 21, 4, 0, m.w, m.h, 9, 5, 9, 12, 12)
    blob += np.concatenate([m.K.ravel(), np.zeros(5), np.eye(3).ravel(), P.ravel()]).astype("<f8").tobytes()
    blob += BODY_OPTICAL[:3].astype("<f4").tobytes()
    for i in range(N):
        pose = (POSES[i] @ np.linalg.inv(BODY_OPTICAL))[:3].astype("<f4").tobytes()
        base.execute("INSERT INTO Node VALUES (?, ?, ?)", (i + 1, TIMES[i], pose))
        images = [cv2.imencode(".png", a)[1].tobytes() for a in (m.color(i), m.mm(i))]
        base.execute("INSERT INTO Data VALUES (?, ?, ?, ?)", (i + 1, *images, blob))
    base.commit()
    base.close()
    return root / "map.db", m


def sens(root):
    m = Moments()
    root.mkdir(parents=True)
    eye = np.eye(4, dtype="<f4").tobytes()
    K4 = [np.block([[K, np.zeros((3, 1))], [np.zeros((1, 3)), 1]]).astype("<f4").tobytes() for K in (m.K, m.K)]
    data = struct.pack("<IQ", 4, 4) + b"name" + K4[0] + eye + K4[1] + eye + struct.pack("<ii", 2, 1)
    data += struct.pack("<IIIIfQ", m.w, m.h, m.w, m.h, 1000.0, N)
    for i in range(N):
        images = (cv2.imencode(".jpg", m.color(i))[1].tobytes(), zlib.compress(m.mm(i).tobytes()))
        us = round(TIMES[i] * 1e6)
        data += POSES[i].astype("<f4").tobytes() + struct.pack("<QQQQ", us, us, *map(len, images)) + b"".join(images)
    put(root / "scene.sens", data)
    return root / "scene.sens", m


def bop(root):
    m = Moments()
    cameras = {}
    for i in range(N):
        put(root / f"depth/{i:06d}.png", m.mm(i) * 10)
        put(root / f"rgb/{i:06d}.png", m.color(i))
        T = np.linalg.inv(POSES[i])
        cameras[str(i)] = {"cam_K": m.K.ravel().tolist(), "depth_scale": 0.1, "cam_R_w2c": T[:3, :3].ravel().tolist()}
        cameras[str(i)]["cam_t_w2c"] = (1000 * T[:3, 3]).tolist()
    put(root / "scene_camera.json", cameras)
    return root, m


def iclnuim(root):
    m, flip = Moments(640, 480), np.diag([1.0, -1, 1, 1])
    m.K = np.array([[481.2, 0, 319.5], [0, 480.0, 239.5], [0, 0, 1]])
    v, u = np.mgrid[:480, :640]
    slant = np.sqrt(((u - 319.5) / 481.2) ** 2 + ((v - 239.5) / 480.0) ** 2 + 1)
    for i in range(N):
        put(root / f"scene_00_{i:04d}.depth", " ".join(f"{x:.8g}" for x in (m.mm(i) / 1000 * slant).ravel()))
        put(root / f"scene_00_{i:04d}.png", m.color(i))
        T = flip @ POSES[i] @ flip
        vectors = {"pos": T[:3, 3], "dir": T[:3, 2], "up": T[:3, 1]}
        lines = "".join(f"cam_{k} = [{', '.join(f'{x:.8f}' for x in x3)}]';\n" for k, x3 in vectors.items())
        put(root / f"scene_00_{i:04d}.txt", lines)
    return root, m


def kinect2(root):
    m = Moments(512, 424)
    for i in range(N):
        put(root / f"depth/{i:06d}.bin", m.mm(i)[:, ::-1].astype("<f4").tobytes())
        put(root / f"registered/{i:06d}.png", m.color(i))
    K = m.K
    put(root / "ir_params.txt", f"fx {K[0, 0]}\nfy {K[1, 1]}\ncx {511 - K[0, 2]}\ncy {K[1, 2]}\n")
    return root, m


def rsconvert(root):
    m = Moments()
    for i in range(N):
        stamp = f"{(1.3e9 + TIMES[i]) * 1000:.6f}"
        put(root / f"scan_Depth_{stamp}.raw", m.mm(i).tobytes())
        put(root / f"scan_Color_{stamp}.png", m.color(i))
    put(root / "rig.json", rig(m))
    return root, m


def ros(root):
    from rosbags import rosbag2
    from rosbags.typesys import Stores, get_typestore

    m, store = Moments(), get_typestore(Stores.ROS2_HUMBLE)
    kinds = {k.split("/")[-1]: v for k, v in store.types.items() if k.split("/")[0] in ("sensor_msgs", "std_msgs")}
    Time = store.types["builtin_interfaces/msg/Time"]
    with rosbag2.Writer(root, version=9) as writer:
        names = {
            "image": "/camera/depth/image_raw",
            "info": "/camera/depth/camera_info",
            "rgb": "/camera/color/image_raw",
        }
        types = {"image": kinds["Image"], "info": kinds["CameraInfo"], "rgb": kinds["Image"]}
        topic = {k: writer.add_connection(n, types[k].__msgtype__, typestore=store) for k, n in names.items()}
        for i, t in enumerate(TIMES):
            head = kinds["Header"](Time(int(t), round(t % 1 * 1e9)), "optical")
            rest = (np.eye(3).ravel(), np.zeros(12), 0, 0, kinds["RegionOfInterest"](0, 0, 0, 0, False))
            info = kinds["CameraInfo"](head, m.h, m.w, "plumb_bob", np.zeros(5), m.K.ravel(), *rest)
            depth = kinds["Image"](head, m.h, m.w, "16UC1", 0, 2 * m.w, m.mm(i).view(np.uint8).ravel())
            color = kinds["Image"](head, m.h, m.w, "rgb8", 0, 3 * m.w, m.color(i).ravel())
            for key, message in (("info", info), ("image", depth), ("rgb", color)):
                data = store.serialize_cdr(message, types[key].__msgtype__)
                writer.write(topic[key], round(t * 1e9), data)
    put(root / "rig.json", {"cameras": {"color": rig(m)["cameras"]["depth"]}, "extrinsics": {}})
    return root, m


def npy(m, i):
    np.save(buffer := io.BytesIO(), m.metres(i))
    return buffer.getvalue()


# format -> (writer, whether times and poses are recorded)
WRITERS = {
    "redwood": (redwood, False, True), "tum": (tum, True, True), "7-scenes": (sevenscenes, False, True),
    "stray": (stray, True, True), "record3d": (record3d, True, True), "polycam": (polycam, True, True),
    "rtabmap": (rtabmap, True, True), "sens": (sens, True, True), "bop": (bop, False, True),
    "icl-nuim": (iclnuim, False, True), "kinect2": (kinect2, False, False), "rs-convert": (rsconvert, True, False),
    "ros": (ros, True, False),
}  # fmt: skip
