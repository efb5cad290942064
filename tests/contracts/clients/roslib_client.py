"""A roslibpy program: `python roslib_client.py URL TRANSPORT`; prints its observations as one JSON object."""

from __future__ import annotations

import base64
import json
import sys
import threading
import time
from typing import Any

import roslibpy

_WAIT_S = 30


def _first(ros: Any, name: str, kind: str, **options: Any) -> Any:
    """Wait for the first message of a topic."""
    found: list[Any] = []
    came = threading.Event()

    def take(message: Any) -> None:
        found.append(message)
        came.set()

    topic = roslibpy.Topic(ros, name, kind, **options)
    topic.subscribe(take)
    if not came.wait(_WAIT_S):
        raise SystemExit(f"nothing on {name}")
    topic.unsubscribe()
    return found[0]


def _call(ros: Any, name: str, kind: str, request: dict[str, Any]) -> Any:
    return dict(roslibpy.Service(ros, name, kind).call(roslibpy.ServiceRequest(request), timeout=_WAIT_S))


def _image(stamp: float, encoding: str, width: int, height: int, data: bytes) -> Any:
    sec = int(stamp)
    head = {"stamp": {"secs": sec, "nsecs": round((stamp - sec) * 1e9)}, "frame_id": "camera"}
    step = len(data) // height
    values = {"header": head, "width": width, "height": height, "encoding": encoding, "step": step}
    return roslibpy.Message(values | {"is_bigendian": 0, "data": base64.b64encode(data).decode()})


def _push_frames(ros: Any, count: int) -> Any:
    """Publish frames of a textured wall 1 m away, and wait until odometry reports them."""
    names = {"color/image_raw": "Image", "depth/image_raw": "Image", "color/camera_info": "CameraInfo"}
    topics = {n: roslibpy.Topic(ros, f"/camera/{n}", f"sensor_msgs/{kind}") for n, kind in names.items()}
    for topic in topics.values():
        topic.advertise()
    width, height = 160, 120
    rgb = bytes((7 * (x // 8) * (y // 8) + 53 * c) % 256 for y in range(height) for x in range(width) for c in range(3))
    depth = (1000).to_bytes(2, "little") * (width * height)
    k = [130.0, 0, 79.5, 0, 130.0, 59.5, 0, 0, 1]
    seen: list[Any] = []
    odometry = roslibpy.Topic(ros, "/maps/ros/odom", "nav_msgs/Odometry")
    odometry.subscribe(seen.append)
    for i in range(count):
        info = {"width": width, "height": height, "distortion_model": "plumb_bob", "k": k}
        topics["color/camera_info"].publish(roslibpy.Message(info))
        topics["depth/image_raw"].publish(_image(1 + i / 10, "16UC1", width, height, depth))
        topics["color/image_raw"].publish(_image(1 + i / 10, "rgb8", width, height, rgb))
        until = time.monotonic() + _WAIT_S
        while len(seen) <= i and time.monotonic() < until:  # mapping takes the newest frame, and drops others
            time.sleep(0.02)
    return [message["pose"]["pose"]["position"] for message in seen]


def _serve_and_call(ros: Any) -> Any:
    def answer(request: Any, response: Any) -> bool:
        response["sum"] = request["a"] + request["b"]
        return True

    service = roslibpy.Service(ros, "/add_two_ints", "example_interfaces/AddTwoInts")
    service.advertise(answer)  # the call follows on the same connection
    return _call(ros, "/add_two_ints", "example_interfaces/AddTwoInts", {"a": 3, "b": 4})


def main(url: str, transport: str, frames: int) -> None:
    """Run the operations that a user of roslibpy performs."""
    ros = roslibpy.Ros(url, transport=transport)
    ros.run(timeout=_WAIT_S)
    cloud = _first(ros, "/map/points", "sensor_msgs/PointCloud2")
    home = [0.0, -0.785398, 0.0, -2.356194, 0.0, 1.570796, 0.785398]
    names = [f"panda_joint{i + 1}" for i in range(7)]
    goal = [
        {"joint_name": n, "position": q + (0.3 if i == 0 else 0.0)}
        for i, (n, q) in enumerate(zip(names, home, strict=True))
    ]
    request = {"goal_constraints": [{"joint_constraints": goal}], "allowed_planning_time": 0.2}
    plan = _call(ros, "/plan_kinematic_path", "moveit_msgs/GetMotionPlan", {"motion_plan_request": request})
    told = {
        "width": cloud["width"],
        "bytes": len(base64.b64decode(cloud["data"])),
        "step": cloud["point_step"],
        "topics": ros.get_topics(),
        "type": ros.get_topic_type("/odom"),
        "time": ros.get_time()["secs"],
        "code": plan["motion_plan_response"]["error_code"]["val"],
        "points": len(plan["motion_plan_response"]["trajectory"].get("joint_trajectory", {}).get("points", [])),
        "sum": _serve_and_call(ros),
        "odometry": _push_frames(ros, frames) if frames else [],
    }
    print(json.dumps(told), flush=True)
    ros.close()


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], int(sys.argv[3]))
