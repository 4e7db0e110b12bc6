"""Time and memory of an import: joint states and commands of an arm at 500 Hz.

    python benchmarks/import_logs.py --minutes 10

Recorded as MCAP and as a database of ROS 2; import runs in a process of its own.
"""

import argparse
import os
import platform
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

EPOCH = 1_700_000_000 * 10**9
RATE = 500
"""Messages of a topic [1/s]."""
JOINTS = 7
RIG = """format = 1
name = "arm"
[model]
type = "acrobot"
m1 = 0.2
m2 = 0.2
l1 = 0.2
l2 = 0.2
lc1 = 0.1
lc2 = 0.1
I1 = 0.001
I2 = 0.001
g = 9.81
friction = "unknown"
[input]
columns = ["tau1", "tau2"]
joints = [1, 2]
[sampling]
dt = 0.002
input_hold = "zero-order"
clock = "sequence"
[measurement]
columns = ["theta1", "theta2", "dtheta1", "dtheta2"]
[import.columns]
tau1 = "/command:data[0]"
tau2 = "/command:data[1]"
theta1 = "/joint_states:position[joint_1]"
theta2 = "/joint_states:position[joint_2]"
dtheta1 = "/joint_states:velocity[joint_1]"
dtheta2 = "/joint_states:velocity[joint_2]"
"""


def write(folder: Path, minutes: float, storage: StoragePlugin) -> Path:
    """The log."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    state, array, layout, header, stamp = (
        store.types[name]
        for name in (
            "sensor_msgs/msg/JointState",
            "std_msgs/msg/Float64MultiArray",
            "std_msgs/msg/MultiArrayLayout",
            "std_msgs/msg/Header",
            "builtin_interfaces/msg/Time",
        )
    )
    names, none = [f"joint_{i}" for i in range(1, JOINTS + 1)], layout(dim=[], data_offset=0)
    rng = np.random.default_rng(0)
    with Writer(folder, version=9, storage_plugin=storage) as bag:
        states = bag.add_connection("/joint_states", state.__msgtype__, typestore=store)
        commands = bag.add_connection("/command", array.__msgtype__, typestore=store)
        for k in range(round(60 * minutes * RATE)):
            t, q = EPOCH + k * 10**9 // RATE, np.sin(0.002 * k + np.arange(JOINTS)) + 1e-3 * rng.normal(size=JOINTS)
            head = header(stamp(t // 10**9, t % 10**9), "base")
            bag.write(states, t, store.serialize_cdr(state(head, names, q, 2 * q, 3 * q), state.__msgtype__))
            bag.write(commands, t + 10**5, store.serialize_cdr(array(none, q), array.__msgtype__))
    return next(path for path in folder.iterdir() if path.suffix in (".mcap", ".db3"))


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--minutes", type=float, default=10)
    args = arguments.parse_args()
    print(f"{time.strftime('%Y-%m-%d')}, {platform.machine()}, Python {platform.python_version()}")
    for storage in (StoragePlugin.MCAP, StoragePlugin.SQLITE3):
        with tempfile.TemporaryDirectory() as spare:
            log, rig = write(Path(spare, "log"), args.minutes, storage), Path(spare, "rig.toml")
            rig.write_text(RIG)
            words = ["import", str(log), "--out", f"{spare}/out", "--rig", str(rig)]
            began = time.perf_counter()
            process = subprocess.Popen([sys.executable, "-m", "nnap_em.cli.main", *words])
            _, status, used = os.wait4(process.pid, 0)
            if status:
                raise SystemExit(f"import ended with status {status}")
            wall, size = time.perf_counter() - began, log.stat().st_size / 2**20
            messages = f"{2 * 60 * args.minutes * RATE / 1e6:.1f} million messages"
            print(f"| {log.suffix} | {size:.0f} MB | {messages} | {wall:.1f} s | {used.ru_maxrss / 2**20:.2f} GB |")


if __name__ == "__main__":
    main()
