"""`jumper bus-sim`: the robot's motors, IMU and motion capture on simulated or virtual CAN buses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from types import ModuleType

from jumper_warp.cli.main import parse


@dataclass(frozen=True)
class BusSimCfg:
    """Simulate the far end of the robot's buses: twelve motors, an IMU and a motion capture."""

    bus: str = "unix:/tmp/jumper-bus"
    """unix:FOLDER or udp_multicast:PORT, as of jumper deploy, or socketcan:vcan0,vcan1,vcan2,vcan3."""
    lockstep: bool = False  # Wait for the runtime's frames at every tick, in place of real time
    rate: int = 480  # [Hz] Ticks a second
    seconds: float = 3600.0  # [s] End after this time
    friction: float = 0.85  # [1] Of the paws
    drop: float = 0.0  # Probability that a frame is lost
    corrupt: float = 0.0  # Probability that a frame arrives as an error frame
    delay: float = 0.0  # Probability that a motor gets its command a tick late
    wire: bool = True  # Whether frames take 0.12 ms each on their bus, in real time
    latency: float = 0.1  # [ms] From a command to the motor's reply, in real time
    temperature: float = 35.0  # [°C] Of the motors
    error_code: int = 0  # Of the first motor's replies
    motor_own_id: bool = False  # Motors reply under their own id, as some firmware
    seed: int = 0  # Of lost, corrupt and late frames


def run(args: Sequence[str], modules: Sequence[ModuleType] = ()) -> None:
    """Run `jumper bus-sim` with the given arguments; modules: unused, as all commands take it.

    Raises InputError: the bus cannot be opened, or a flag is wrong.
    """
    cfg = parse(BusSimCfg, "bus-sim", args)
    from jumper_warp.bench.bus_sim import BusFaults, BusSim
    from jumper_warp.bench.pace import serve_in_real_time
    from jumper_warp.deploy.bus import open_buses

    faults = BusFaults(cfg.drop, cfg.corrupt, cfg.delay, cfg.temperature, cfg.motor_own_id, cfg.seed)
    far = BusSim(open_buses(cfg.bus, "robot"), faults, rate=cfg.rate, friction=cfg.friction)
    far.error_code[0] = cfg.error_code
    print(f"bus-sim on {cfg.bus}", flush=True)
    try:
        if not cfg.lockstep:
            serve_in_real_time(far, cfg.seconds, wire=cfg.wire, latency=1.0e-3 * cfg.latency)
            return
        ticks = 0
        while ticks < cfg.seconds * cfg.rate and far.serve():
            ticks += 1
    except KeyboardInterrupt:
        pass
    finally:
        for bus in far.buses:
            bus.shutdown()
