"""A serial port: its rate, unplugging and plugging in again, garbage, and rows that are cut off."""

import os
import threading
import time
from contextlib import closing

import log_bench
import numpy as np
import pytest

from multipos.capturing.keeping import Kept
from multipos.capturing.running import make_plan, make_reading, run_session
from multipos.capturing.serial_port import read_port, split_port
from multipos.capturing.session import Session
from multipos.capturing.sources import open_source
from multipos.capturing.state import state_of
from multipos.cli import main

serial = pytest.importorskip("serial", reason="pyserial is an extra")
tty = pytest.importorskip("tty", reason="no pseudo terminals")
termios = pytest.importorskip("termios", reason="no pseudo terminals")

ROWS = b"0.01,0.1,0.2,0.9\n0.02,0.1,0.2,0.9\n0.03,0.1,0.2,0.9\n"


class Device:
    """A device at a serial port: the far end of a pseudo terminal, which can be unplugged."""

    def __init__(self, folder):
        self.path = folder / "ttyUSB0"
        self.plug_in()

    def plug_in(self):
        self.far, self.near = os.openpty()
        os.set_blocking(self.far, False)
        tty.setraw(self.near)
        self.path.unlink(missing_ok=True)
        self.path.symlink_to(os.ttyname(self.near))

    def say(self, content, listener):
        """Write it all, as long as there is who reads it."""
        while content and listener.is_alive():
            try:
                content = content[os.write(self.far, content[:1024]) :]
            except BlockingIOError:  # a terminal holds four kilobytes
                time.sleep(0.001)

    def unplug(self):
        self.path.unlink()
        os.close(self.near)
        os.close(self.far)


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    path = tmp_path_factory.mktemp("serial") / "log.csv"
    return log_bench.write_csv(path, log_bench.columns_of(scheme="all-26", seed=3))


def heard(chunks, looks, enough=lambda found: False):
    """What comes until it is enough, or until nothing has come some times."""
    found, silent = b"", 0
    while silent < looks and not enough(found):
        chunk = next(chunks)
        silent = 0 if chunk else silent + 1
        found += chunk or b""
    return found


def hear(chunks, expected):
    """See that these lines come, and nothing else."""
    found = heard(chunks, 1000, lambda found: len(found.split()) >= len(expected.split()))
    assert (found + heard(chunks, 2)).split() == expected.split()


@pytest.mark.parametrize(("asked", "rate"), [("", 115200), (":9600", 9600), (":921600", 921600)])
def test_the_port_runs_at_the_rate_that_was_asked_for(tmp_path, asked, rate):
    device = Device(tmp_path)
    name, baud = split_port(f"{device.path}{asked}")
    assert (name, baud) == (str(device.path), rate)
    with closing(read_port(name, baud)) as chunks:
        next(chunks)
        speeds = termios.tcgetattr(device.near)[4:6]
    assert speeds == [getattr(termios, f"B{rate}")] * 2
    device.unplug()


def test_a_device_may_have_colons_in_its_name():
    path = "/dev/serial/by-path/pci-0000:00:14.0-usb-0:2:1.0-port0"
    assert split_port(path) == (path, 115200)
    assert split_port(f"{path}:57600") == (path, 57600)
    assert split_port("COM3:57600") == ("COM3", 57600)


@pytest.mark.parametrize("rate", ["0", "2147483648", "99999999999999999999"])
def test_a_rate_that_no_port_has_is_refused(rate, capsys):
    assert main(["capture", f"serial:/dev/ttyS0:{rate}", "--headless"]) == 2
    assert f"no port runs at {rate} baud" in capsys.readouterr().err


@pytest.mark.parametrize("fault", [ValueError("Invalid baud rate: 31"), termios.error(22, "no")])
def test_what_the_driver_refuses_ends_in_one_line(fault, tmp_path, monkeypatch, capsys):
    def refuse(*_, **__):
        raise fault

    monkeypatch.setattr(serial, "Serial", refuse)
    monkeypatch.chdir(tmp_path)
    assert main(["capture", "serial:/dev/ttyS0:31", "--headless"]) == 1
    said = capsys.readouterr().err.splitlines()[-1]
    assert said.startswith("multipos: error: /dev/ttyS0: cannot open the port: ")
    assert str(fault) in said


@pytest.mark.parametrize(
    ("first", "kept"),
    [
        (b"time,ax,ay,az\n", True),  # a device that starts when its port is opened
        (b"boot v2\r\n", True),
        (b"01,0.1,0.2,0.9\n", False),  # of 0.01: a whole row of another time
        (b"0.9\r\n", False),
        (b"-9; 1,5; 2e-3\n", False),
    ],
)
def test_what_is_left_of_a_row_is_none(tmp_path, first, kept):
    device = Device(tmp_path)
    with closing(read_port(str(device.path), 115200)) as chunks:
        next(chunks)
        os.write(device.far, first[:1])
        assert heard(chunks, 8) == b""  # nothing before the line has ended
        os.write(device.far, first[1:] + ROWS)
        hear(chunks, (first if kept else b"") + ROWS)
    device.unplug()


def test_it_is_none_each_time_the_port_is_plugged_in(tmp_path, monkeypatch):
    monkeypatch.setattr("multipos.capturing.serial_port._RETRY", 0.01)
    device = Device(tmp_path)
    with closing(read_port(str(device.path), 115200)) as chunks:
        for cut in (b"12,0.1,0.2,0.9\n", b"0.2", b"2,0.9\n"):
            while next(chunks) is None:
                pass
            os.write(device.far, cut)
            if cut.endswith(b"\n"):
                os.write(device.far, ROWS)
                hear(chunks, ROWS)
            else:  # lost again before the first line has ended
                assert heard(chunks, 8) == b""
            device.unplug()
            assert next(chunks) is None
            device.plug_in()
    device.unplug()


def test_a_line_that_never_ends_is_not_waited_for(tmp_path, monkeypatch):
    monkeypatch.setattr("multipos.capturing.serial_port._LONGEST", 1000)
    device = Device(tmp_path)
    with closing(read_port(str(device.path), 115200)) as chunks:
        next(chunks)
        os.write(device.far, b"A" * 2000)
        hear(chunks, b"A" * 2000)
    device.unplug()


def test_another_baud_rate_is_thought_of_where_no_rows_come(tmp_path, monkeypatch, capsys):
    """At a wrong rate a port gives bytes of any kind, line ends among them."""
    noise = np.random.default_rng(1).integers(0, 256, 1 << 19, dtype=np.uint8).tobytes()

    def chunks(*_):
        yield noise

    monkeypatch.setattr("multipos.capturing.sources.read_port", chunks)
    monkeypatch.chdir(tmp_path)
    assert main(["capture", "serial:/dev/ttyS0:9600", "--headless"]) == 1
    said = capsys.readouterr().err.splitlines()[-1]
    assert said.startswith("multipos: error: serial:/dev/ttyS0:9600: ")
    assert said.endswith("check what sends them, and the baud rate of a serial port.")


@pytest.fixture
def opened(monkeypatch):
    """Set when a port has been opened: what had come before is thrown away then."""
    found = threading.Event()

    class Port(serial.Serial):
        def open(self):
            super().open()
            found.set()

    monkeypatch.setattr(serial, "Serial", Port)
    return found


def test_a_first_row_that_is_cut_off_leaves_the_time_alone(log, tmp_path, opened):
    """It was read as a row of another time, which did not rise and was an output then."""
    rows = log.read_bytes().splitlines(keepends=True)
    device = Device(tmp_path)
    session = Session(make_plan((), 3, None, {}), make_reading(None, None, None, None, None, 3e-3))
    source = open_source(f"serial:{device.path}")
    run = threading.Thread(target=run_session, args=(session, source), daemon=True)
    run.start()
    assert opened.wait(300)
    device.say(rows[35].partition(b".")[2] + b"".join(rows[36:3000]), run)
    run.join(300)
    assert session.finished
    assert session.rows.clock is not None
    assert session.rows.outputs == ("2", "3", "4")
    assert (session.rows.gaps, session.rows.bad) == (0, 0)
    device.unplug()


def test_a_serial_port_may_be_unplugged(log, tmp_path, monkeypatch, opened):
    monkeypatch.setattr("multipos.capturing.serial_port._RETRY", 0.05)
    rows = log.read_bytes().splitlines(keepends=True)
    device = Device(tmp_path)
    session = Session(make_plan((), 5, None, {}), make_reading(None, None, None, None, None, 3e-3))
    source = open_source(f"serial:{device.path}:115200")
    kept = Kept(log=tmp_path / "kept.csv")
    run = threading.Thread(target=run_session, args=(session, source, None, kept), daemon=True)
    run.start()

    def wait(condition):
        for _ in range(30_000):
            with session.changed:
                if condition():
                    return
            time.sleep(0.01)
        raise AssertionError(state_of(session))

    assert opened.wait(300)
    opened.clear()
    device.say(b"".join(rows[:1500]) + b"\xff\x00boot v2\r\n" + rows[1500][:11], run)
    wait(lambda: session.rows is not None and session.rows.rows == 1499)
    assert session.connected
    device.unplug()
    wait(lambda: not session.connected)
    assert state_of(session)["connected"] is False
    device.plug_in()
    assert opened.wait(300)
    device.say(rows[1503][7:] + b"".join(rows[1504:2600]), run)
    wait(lambda: session.rows.rows == 1499 + 1096)
    assert session.connected
    assert session.rows.bad == 1  # what is no row; what was left of one is not even that
    assert session.rows.gaps == 1
    device.say(b"".join(rows[2600:5000]), run)
    run.join(300)
    assert session.finished
    assert len(session.accepted) == 5
    device.unplug()
    read = (tmp_path / "kept.csv").read_bytes().splitlines(keepends=True)
    whole = [line for line in read if not line.startswith(b"#")]
    assert whole == [*rows[:1500], *rows[1504:]][: len(whole)]
    assert len(read) == len(whole) + 1


def test_a_port_that_is_not_there_ends_in_one_line(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for _ in range(2):
        assert main(["capture", f"serial:{tmp_path}/none:9600", "--headless"]) == 1
        assert "cannot open the port" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
