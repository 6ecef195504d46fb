"""`jumper deploy` and exports for it: wrong settings and flags, damaged logs, a far end that stops."""

import errno
import json
import os
import shutil
import socket
import threading
import time

import can
import numpy as np
import pytest

from jumper_warp.cli.export import run as export
from jumper_warp.deploy import bus, main
from jumper_warp.deploy.bundle import FILE, Bundle
from jumper_warp.deploy.check import check_bundle
from jumper_warp.deploy.log import read_log
from jumper_warp.deploy.operator import JOYSTICK, Keyboard
from jumper_warp.deploy.runtime import TICK, Request
from jumper_warp.utils.errors import InputError


def refusal(capsys, *args):
    """Run the command, which must exit with code 2, and return its line on standard error."""
    with pytest.raises(SystemExit) as end:
        main.main([str(arg) for arg in args])
    assert end.value.code == 2
    return capsys.readouterr().err.splitlines()[-1]


@pytest.mark.parametrize(
    "text", [b"", b"- 1\n", b"version: 1\n", bytes(range(256))], ids=["no", "list", "short", "bytes"]
)
def test_settings_that_are_none_are_refused(text, bundle_folder, tmp_path):
    folder = shutil.copytree(bundle_folder, tmp_path / "bundle")
    (folder / FILE).write_bytes(text)
    with pytest.raises(InputError, match=r"deploy\.yaml"):
        Bundle(folder)


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--seconds=0"], "seconds above 0"),
        (["--seconds=nan"], "seconds above 0"),
        (["--height=nan"], "height and place must be finite"),
        (["--place", "inf", "0"], "height and place must be finite"),
        (["--bus=unix:"], "bus must be"),
    ],
)
def test_wrong_flag_is_refused(flags, message, bundle_folder, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert message in refusal(capsys, bundle_folder, "--bus=unix:bus", "--seconds=0.01", *flags)


@pytest.mark.parametrize("rate", [0, "abc", 1000])
def test_wrong_rate_is_refused(rate, edited, tmp_path, capsys):
    folder = edited(lambda settings: settings.update(rate=rate))
    assert "rate must be" in refusal(capsys, folder, "--bus", f"unix:{tmp_path}/bus", "--seconds", 0.01)


def test_folder_of_a_running_process_is_refused(bundle_folder, tmp_path, capsys):
    first = bus.open_buses(f"unix:{tmp_path}/bus")
    for _ in range(2):
        assert "another process uses" in refusal(capsys, bundle_folder, "--bus", f"unix:{tmp_path}/bus")
    other = bus.open_buses(f"unix:{tmp_path}/bus", "robot")
    other[0].send(bus.data_frame(1, b"frame"))
    assert bytes(first[0].recv(10.0).data) == b"frame"  # still connected
    for each in [*first, *other]:
        each.shutdown()


def test_sockets_of_a_dead_process_are_replaced(tmp_path):
    for number in range(4):
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as dead:
            dead.bind(str(tmp_path / f"host{number}"))
    for each in bus.open_buses(f"unix:{tmp_path}"):
        each.shutdown()


def test_log_that_exists_is_kept(bundle_folder, tmp_path, capsys):
    (tmp_path / "log").mkdir()
    (tmp_path / "log" / "ticks.bin").write_bytes(b"recorded")
    args = ("--bus", f"unix:{tmp_path}/bus", "--seconds", 0.01, "--log", tmp_path / "log")
    assert "File exists" in refusal(capsys, bundle_folder, *args)
    assert [path.name for path in (tmp_path / "log").iterdir()] == ["ticks.bin"]
    assert (tmp_path / "log" / "ticks.bin").read_bytes() == b"recorded"


@pytest.fixture
def silent_robot(tmp_path):
    """Function that answers some ticks of a runtime in lockstep, without frames, and returns the buses."""
    spec = f"unix:{tmp_path}/bus"
    far = bus.open_buses(spec, "robot")
    threads = []

    def answer(ticks):
        """End the frames of each tick."""
        for _ in range(ticks):
            for each in far:
                while each.recv(20.0).arbitration_id != bus.SYNC:
                    pass
                each.send(bus.data_frame(bus.SYNC, b""))

    def start(ticks):
        """Answer in the background."""
        threads.append(threading.Thread(target=answer, args=(ticks,)))
        threads[0].start()
        return spec

    yield start
    threads[0].join()
    for each in far:
        each.shutdown()


def test_run_in_lockstep_without_a_time_ends_with_its_far_end(bundle_folder, silent_robot, monkeypatch, capsys):
    monkeypatch.setattr(bus, "LOCKSTEP_TIMEOUT", 0.3)
    assert "no frames in lockstep" in refusal(capsys, bundle_folder, "--bus", silent_robot(3), "--lockstep")


def test_reason_for_motors_that_stay_off_is_printed(bundle_folder, silent_robot, capsys):
    """No motor replies, so that the request to stand is refused."""
    ticks = 400 + 960 + 4  # of the run, and of its end
    main.main([str(bundle_folder), "--bus", silent_robot(ticks), "--demo", "--lockstep", "--seconds", str(400 / 480)])
    assert capsys.readouterr().out.splitlines() == ["PASSIVE SILENT"]


def test_runtime_that_ends_brakes_for_2_s_without_its_watchdog(bundle_folder, tmp_path, monkeypatch):
    """A beat each tick keeps the watchdog from braking."""
    beats = []

    class Counted(main.Watchdog):
        """Watchdog whose beats are recorded."""

        def beat(self):
            """Record the time of a beat."""
            beats.append(time.monotonic())
            super().beat()

    monkeypatch.setattr(main, "Watchdog", Counted)
    main.main([str(bundle_folder), "--bus", f"unix:{tmp_path}/bus", "--demo", "--seconds", "0.1"])
    assert len(beats) > 2 * 480 and beats[-1] - beats[0] > 2.0  # [s]


def test_full_disk_ends_the_log_and_not_the_run(bundle_folder, silent_robot, tmp_path, monkeypatch, capsys):
    """The third write of a frame fails."""
    written = []

    class Full:
        """Logger on a disk for two frames."""

        def __init__(self, path):
            self.path = path

        def __call__(self, message):
            """Write, or fail."""
            written.append(message)
            if len(written) > 2:
                raise OSError(errno.ENOSPC, "No space left on device")

        def stop(self):
            """Do nothing."""

    monkeypatch.setattr(can, "Logger", Full)
    ticks = 400 + 960 + 4  # of the run, and of its end
    args = ["--demo", "--lockstep", "--seconds", str(400 / 480), "--log", str(tmp_path / "log")]
    main.main([str(bundle_folder), "--bus", silent_robot(ticks), *args])
    printed = capsys.readouterr()
    assert printed.out.splitlines() == ["PASSIVE SILENT"]
    assert printed.err.count("the log ends, the robot continues") == 1 and len(written) == 3


def test_gamepad_stops_the_robot_when_the_standard_input_is_at_its_end(tmp_path, monkeypatch):
    (tmp_path / "pad").write_bytes(JOYSTICK.pack(0, 1, 1, 1))  # button 1 is pressed
    with open(os.devnull) as empty:
        monkeypatch.setattr("sys.stdin", empty)
        assert Keyboard(0.7, (0.5, 0.0), str(tmp_path / "pad")).poll()[0] == Request.STOP


ABOUT = {"version": 1, "rate": 480, "capture": False, "tick_bytes": TICK.itemsize}


@pytest.mark.parametrize(
    ("about", "ticks"), [([1], 3), (ABOUT | {"rate": 0}, 3), ({"version": 1}, 3), (ABOUT, 0), (ABOUT, -3)]
)
def test_damaged_log_is_refused(about, ticks, tmp_path):
    """A negative number of ticks: they have a request that does not exist."""
    records = np.zeros(abs(ticks), TICK)
    records["request"] = 0 if ticks >= 0 else -90
    (tmp_path / "log.json").write_text(json.dumps(about))
    (tmp_path / "ticks.bin").write_bytes(records.tobytes())
    with pytest.raises(InputError, match="damaged"):
        read_log(tmp_path)


def test_bundle_can_be_overwritten(bundle_folder, tmp_path):
    folder = shutil.copytree(bundle_folder, tmp_path / "bundle")
    (folder / "jumper.dbc").write_text("changed")
    with pytest.raises(InputError, match="overwrite replaces it"):
        export(["vertical_jump", "--bundle", "--out", str(folder)])
    export(["vertical_jump", "--bundle", "--out", str(folder), "--overwrite"])
    assert check_bundle(Bundle(folder)) == []
    assert (folder / "jumper.dbc").read_bytes() == (bundle_folder / "jumper.dbc").read_bytes()
