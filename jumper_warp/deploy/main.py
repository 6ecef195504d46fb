"""`jumper deploy BUNDLE` and `python deploy.pyz BUNDLE`: check a bundle, run the robot, or replay a log."""

from __future__ import annotations

import argparse
import itertools
import json
import logging
import os
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from pathlib import Path

import numpy as np

from jumper_warp.deploy.bundle import Bundle
from jumper_warp.deploy.bus import Link, open_buses
from jumper_warp.deploy.check import check_bundle
from jumper_warp.deploy.log import Log, replay
from jumper_warp.deploy.operator import HELP, NOTHING, Keyboard, raw_terminal
from jumper_warp.deploy.realtime import real_time, run_loop
from jumper_warp.deploy.runtime import RATES, Request, Runtime, State
from jumper_warp.deploy.sensors import MotionCapture
from jumper_warp.deploy.watchdog import Watchdog
from jumper_warp.utils.errors import InputError


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    flags = argparse.ArgumentParser("jumper deploy", description="Run policies on the robot.", epilog=HELP)
    flags.formatter_class = argparse.RawDescriptionHelpFormatter
    flags.add_argument("bundle", type=Path, help="folder of jumper export POLICY ... --bundle")
    flags.add_argument("--check", action="store_true", help="compare the bundle with its conformance vectors, and end")
    flags.add_argument("--replay", type=Path, metavar="LOG", help="run a log through the runtime, and compare commands")
    flags.add_argument("--bus", help="socketcan:can0,can1,can2,can3, udp_multicast:PORT or unix:FOLDER")
    flags.add_argument("--rate", type=int, choices=RATES, help="ticks a second (default: of deploy.yaml)")
    flags.add_argument("--dry-run", action="store_true", help="compute commands, and keep the motors off")
    flags.add_argument("--capture", action="store_true", help="take the state of a motion capture, not the estimator")
    flags.add_argument("--lockstep", action="store_true", help="wait for jumper bus-sim --lockstep at every tick")
    flags.add_argument("--seconds", type=float, default=float("inf"), help="[s] end after this time")
    flags.add_argument("--demo", action="store_true", help="stand up, walk and jump without an operator (bus-sim only)")
    flags.add_argument("--height", type=float, default=0.7, help="[m] height of the base in jumps up (key j)")
    flags.add_argument("--place", type=float, nargs=2, default=(0.5, 0.0), help="[m] ahead and left (key g)")
    flags.add_argument("--log", type=Path, help="folder for the log")
    return flags


def main(args: Sequence[str] | None = None) -> None:
    """Run the command; exits with 1 if a check fails, and with 2 and one line if the input is invalid."""
    options = parser().parse_args(args)
    sys.stdin = sys.stdin or Path(os.devnull).open()  # None: closed
    logging.getLogger("can.bus").setLevel(logging.ERROR)  # after an error, buses are closed with the process
    try:
        bundle = Bundle(options.bundle)
        if bundle.edited:
            print("deploy.yaml was edited after the export: check it with --check", file=sys.stderr)
        if options.check:
            differences = check_bundle(bundle)
            print("\n".join(differences or [f"{len(bundle.policies)} policies conform"]))
            raise SystemExit(bool(differences))
        if options.replay is not None:
            count, first = replay(options.replay, bundle)
            print(f"{count} ticks repeat bit for bit" if first < 0 else f"tick {first} differs")
            raise SystemExit(first >= 0)
        if not options.bus:
            raise InputError("--bus, --check or --replay is needed")
        run(bundle, options)
    except (InputError, OSError) as error:
        print(f"jumper deploy: {error}", file=sys.stderr)
        raise SystemExit(2) from None


DEMO = (
    (0.8, Request.STAND, ()), (1.0, Request.CONFIRM, ()), (5.5, Request.WALK, (0.4, 0.0, 0.0)),
    (8.0, Request.JUMP_UP, (0.8, 0.0, 0.0)), (13.0, Request.WALK, (0.3, 0.0, 0.3)),
    (15.5, Request.JUMP_TO, (0.8, 0.2, 0.0)), (20.5, Request.WALK, (0.4, 0.0, 0.0)),
)  # fmt: skip
"""Requests of the demo: time [s], request, values. They repeat from the first walk on."""


def run(bundle: Bundle, options: argparse.Namespace) -> None:
    """Run the robot until the operator quits (Ctrl-C) or the time is over, then brake and switch the motors off."""
    rate = options.rate or bundle.settings.get("rate")
    if rate not in RATES or not options.seconds > 0.0:
        raise InputError(f"the rate must be 480 or 500 Hz and seconds above 0, got {rate} and {options.seconds}")
    if not np.isfinite([options.height, *options.place]).all():
        raise InputError(f"height and place must be finite, got {options.height} and {options.place}")
    pump = (lambda: None) if options.lockstep else None
    with bundle.reading():
        link = Link([], reply_id=bundle.settings["can"]["reply_id"], deadline=0.6 / rate, pump=pump)
        source = MotionCapture() if options.capture else None
        runtime = Runtime(bundle, link, source, rate=rate, dry_run=options.dry_run)
    link.buses = open_buses(options.bus)
    log = options.log and Log(options.log, bundle, rate, capture=options.capture, dry_run=options.dry_run)
    if log is not None:
        link.listener, runtime.listener = log.frame, log.tick
    dog = None if options.lockstep else Watchdog(options.bus, bundle.settings)
    operator = Keyboard(options.height, options.place)
    first, last_at = round(DEMO[2][0] * rate), round(DEMO[-1][0] * rate)
    demo = {round(at * rate): (request, values) for at, request, values in DEMO}
    ticks, last, replies = itertools.count(), (State.PASSIVE, 0), 0

    def tick(late: float) -> None:
        """Run a tick with the operator's request, and print changes of the state and of the fault that ended it."""
        nonlocal last, replies, ticks
        count = next(ticks)
        count = count if count <= last_at else first + (count - first) % (last_at - first)
        record = runtime.tick(*(demo.get(count, NOTHING) if options.demo else operator.poll()), late=late)
        if record["request"] == Request.STAND and runtime.state == State.PASSIVE:
            ticks = itertools.count()  # the demo tries again
        replies += np.count_nonzero(record["received"]["motor_fresh"])
        if dog is not None:
            dog.beat()
        if (runtime.state, runtime.reason) != last:
            last = (runtime.state, runtime.reason)
            print(f"{runtime.state.name} {runtime.reason.name if runtime.reason else ''}", flush=True)

    with ExitStack() as until_stopped:  # also for the ticks that brake
        try:
            with raw_terminal():
                if options.lockstep:
                    for _ in itertools.takewhile(lambda number: number < options.seconds * rate, itertools.count()):
                        tick(0.0)
                else:
                    until_stopped.enter_context(real_time())
                    result = run_loop(tick, rate, options.seconds)
                    print(json.dumps(result | {"replies_lost": 1.0 - replies / (12 * result["ticks"])}))
        except KeyboardInterrupt:
            pass
        finally:
            for request in [Request.STOP, *[Request.NONE] * 2 * rate, Request.PASSIVE, Request.NONE, Request.NONE]:
                begin = time.monotonic()
                runtime.tick(request)
                if dog is not None:
                    with suppress(InputError):  # it brakes too
                        dog.beat()
                    time.sleep(max(0.0, begin + 1.0 / rate - time.monotonic()))
        if dog is not None:
            dog.close()
        link.close()
        if log is not None:
            log.close()
