"""`jumper bus-sim`: the robot's motors, IMU and motion capture on simulated or virtual CAN buses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from types import ModuleType

from jumper_warp.bench.faults import BusFaults
from jumper_warp.cli.flags import parse
from jumper_warp.utils.checks import check_count, check_not_negative, check_number, check_probabilities, check_seed


@dataclass
class BusSimCfg(BusFaults):
    """Simulate the far end of the robot's buses: twelve motors, an IMU and a motion capture."""

    bus: str = "unix:/tmp/jumper-bus"
    """unix:FOLDER or udp_multicast:PORT, as of jumper deploy, or socketcan:vcan0,vcan1,vcan2,vcan3."""
    lockstep: bool = False  # Wait for the runtime's frames at every tick, in place of real time
    rate: int = 480  # [Hz] Ticks a second
    seconds: float = 3600.0  # [s] End after this time
    friction: float = 0.85  # [1] Of the paws
    latency: float = 0.1  # [ms] From a command to the motor's reply, in real time


def run(args: Sequence[str], modules: Sequence[ModuleType] = ()) -> None:
    """Run `jumper bus-sim` with the given arguments; modules: unused, as all commands take it.

    Raises InputError: the bus cannot be opened, or a flag is wrong.
    """
    cfg = parse(BusSimCfg, "bus-sim", args)
    from jumper_warp.bench.bus_sim import BusSim, make_simulation
    from jumper_warp.bench.pace import serve_in_real_time
    from jumper_warp.deploy.bus import open_buses

    check_count("rate", cfg.rate)
    check_seed(cfg.seed)
    check_probabilities("bus-sim", cfg, "drop", "corrupt", "delay")
    for name in ("gyro_noise", "accel_noise", "seconds", "latency"):
        check_not_negative(name, getattr(cfg, name))
    check_number("latency", cfg.latency, 0.0, 1000.0, "ms")
    far = BusSim(open_buses(cfg.bus, "robot"), cfg, sim=make_simulation(1.0 / cfg.rate, cfg.friction))
    print(f"bus-sim on {cfg.bus}", flush=True)
    try:
        if cfg.lockstep:
            all(far.serve() for _ in range(round(cfg.seconds * cfg.rate)))  # until the runtime ends
        else:
            serve_in_real_time(far, cfg.seconds, 1.0e-3 * cfg.latency)
    except KeyboardInterrupt:
        pass
    finally:
        for bus in far.buses:
            bus.shutdown()
