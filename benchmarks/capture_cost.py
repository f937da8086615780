"""What a guided session costs: the way of a row to the page, processor time, and memory.

`latency`: a session on its own process takes datagrams at 1 kHz, a pose in six seconds; a reader of
its event stream knows of every event which row came last, and when that was sent. A processor that
others share keeps the session waiting; the kernel counts for how long, and that is told apart.
`long`: eight hours at 1 kHz, a pose in ten minutes, through a pipe, as fast as it goes: processor
time in all, and the peak of memory.
"""

import argparse
import http.client
import json
import os
import re
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

import multipos as mp

RATE = 1000
MOVE = 2.0  # [s] of a pose
NOISE, SHAKING = 1e-3, 0.2  # [g]


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.capture_cost")
    parser.add_argument("what", choices=["latency", "long"])
    parser.add_argument("--seconds", type=float, default=120.0, help="of the session to be timed")
    parser.add_argument("--hours", type=float, default=8.0, help="of the long session")
    chosen = parser.parse_args()
    if chosen.what == "latency":
        latency(chosen.seconds)
    else:
        long(chosen.hours)


def rows(period: float, seconds: float, seed: int = 1) -> Iterator[list[str]]:
    """Yield the rows of a twentieth of a second each: a pose, and the way to the next."""
    rng = np.random.default_rng(seed)
    poses = rng.permutation(np.concatenate([mp.read_scheme("all-26").up] * 20))
    count = RATE // 20
    for i in range(round(20 * seconds)):
        t = i / 20 % period
        up = poses[int(i / 20 / period) % len(poses)]
        noise = (SHAKING if t < MOVE else NOISE) * rng.standard_normal((count, 3))
        time_ = (i * count + np.arange(count)) / RATE
        yield [
            f"{at:.3f},{x:.6f},{y:.6f},{z:.6f}"
            for at, (x, y, z) in zip(time_.tolist(), (up + noise).tolist(), strict=True)
        ]


def start(source: str, folder: str, *more: str) -> "subprocess.Popen[str]":
    command = [sys.executable, "-m", "multipos", "capture", source, "-o", f"{folder}/run.csv"]
    return subprocess.Popen(
        [*command, "--columns", "time,ax,ay,az", *more],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE if "--headless" not in more else None,
        text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )


def latency(seconds: float) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    with tempfile.TemporaryDirectory() as folder:
        process = start(f"udp:{port}", folder, "--port", "0")
        assert process.stderr is not None
        page = next(found[1] for line in process.stderr if (found := re.search(r":(\d+)/", line)))
        sent: list[float] = []
        sender = threading.Thread(target=send, args=(port, seconds, sent))
        before = used(process.pid)
        sender.start()
        seen = watch(int(page), process.pid, sender)
        share = 100.0 * (used(process.pid) - before) / seconds
        print(f"{share:.2f} % of a core for rows and page")
        process.terminate()
        process.wait()
    tell(seen, np.array(sent))


def long(hours: float) -> None:
    with tempfile.TemporaryDirectory() as folder:
        begun = time.monotonic()
        process = start("-", folder, "--headless")
        assert process.stdin is not None
        for part in rows(600.0, 3600.0 * hours):
            process.stdin.write("\n".join(part) + "\n")
        process.stdin.close()
        _, status, spent = os.wait4(process.pid, 0)
        assert status == 0
        taken = Path(folder, "run.csv").read_text().count("\n") - 1
    took = spent.ru_utime + spent.ru_stime
    print(f"{taken} poses, {3600 * RATE * hours:.0f} rows in {time.monotonic() - begun:.0f} s")
    print(f"{100 * took / 3600 / hours:.2f} % of a core, {spent.ru_maxrss / 1024:.0f} MB")


def send(port: int, seconds: float, sent: list[float]) -> None:
    """Send rows when they are due, and note when each was sent."""
    begun = time.monotonic()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for part in rows(6.0, seconds):
            for row in part:
                wait = begun + len(sent) / RATE - time.monotonic()
                if wait > 0.0:
                    time.sleep(wait)
                sent.append(time.monotonic())
                sender.sendto(row.encode(), ("127.0.0.1", port))


def watch(page: int, process: int, sender: threading.Thread) -> list[tuple[str, int, float, float]]:
    """Return kind, rows, time and what the session had waited for a processor by then, by event."""
    connection = http.client.HTTPConnection("127.0.0.1", page, timeout=30)
    connection.request("GET", "/events")
    answer = connection.getresponse()
    seen = []
    kind = ""
    while sender.is_alive():
        line = answer.readline().decode()
        if line.startswith("event: "):
            kind = line[7:].strip()
        elif line.startswith("data: "):
            at = time.monotonic()
            found = json.loads(line[6:])
            seen.append((kind, found["rows"], at, waited(process)))
    connection.close()
    return seen


def used(process: int) -> float:
    """Return the processor time [s] of a process."""
    ticks = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[11:13]
    return sum(map(float, ticks)) / os.sysconf("SC_CLK_TCK")


def waited(process: int) -> float:
    """Return for how long [s] the threads of a process have waited for a processor."""
    total = 0
    for thread in Path(f"/proc/{process}/task").iterdir():
        try:
            total += int((thread / "schedstat").read_text().split()[1])
        except OSError:
            continue
    return 1e-9 * total


def tell(seen: list[tuple[str, int, float, float]], sent: np.ndarray) -> None:
    """Print how long after a row the first event came that holds it."""
    events = [event for event in seen if 0 < event[1] <= len(sent)]
    held = 1e3 * np.diff([event[3] for event in events], prepend=events[0][3])
    shown = np.array([event[1] for event in events])
    first = np.searchsorted(shown, np.arange(1, shown[-1] + 1))
    late = 1e3 * (np.array([event[2] for event in events])[first] - sent[: len(first)])
    state = np.array([kind == "state" for kind, *_ in events])[first]
    free = held[first] < 1.0
    print("| rows | | median ms | 95 % | 99 % | most |\n|---|---|---|---|---|---|")
    for name, chosen in (("all", state | True), ("in a state", state), ("not kept waiting", free)):
        x = late[chosen]
        print(
            f"| {name} | {len(x)} | {np.median(x):.0f} | {np.quantile(x, 0.95):.0f} | "
            f"{np.quantile(x, 0.99):.0f} | {x.max():.0f} |"
        )
    print(f"kept waiting for a processor: {held.sum() / 1e3:.2f} s")


if __name__ == "__main__":
    main()
