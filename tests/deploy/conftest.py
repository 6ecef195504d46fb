"""A bundle of the shipped policies, and a robot on simulated buses in lockstep."""

import shutil

import pytest
import yaml

from jumper_warp.bench.bundle import export_bundle
from jumper_warp.bench.bus_sim import BusSim, make_simulation
from jumper_warp.deploy.bundle import FILE, Bundle
from jumper_warp.deploy.bus import Link, open_buses
from jumper_warp.deploy.runtime import REST_TICKS, Request, Runtime, State
from jumper_warp.deploy.sensors import MotionCapture
from jumper_warp.policies.policy import load_policy

POLICIES = ("vertical_jump", "horizontal_jump", "walking")


@pytest.fixture(scope="session")
def bundle_folder(tmp_path_factory):
    """Folder of a bundle with the shipped policies."""
    return export_bundle([(name, load_policy(name)) for name in POLICIES], tmp_path_factory.mktemp("bundle"))


@pytest.fixture(scope="session")
def bundle(bundle_folder):
    """Bundle of the shipped policies."""
    return Bundle(bundle_folder)


@pytest.fixture
def edited(bundle_folder, tmp_path):
    """Function that returns a copy of the bundle's folder, whose settings a function changes."""

    def edit(change):
        folder = shutil.copytree(bundle_folder, tmp_path / "bundle")
        settings = yaml.safe_load((folder / FILE).read_text())
        change(settings)
        (folder / FILE).write_text(yaml.safe_dump(settings, sort_keys=False))
        return folder

    return edit


class Robot:
    """A runtime and its simulated far end; `run` advances both."""

    def __init__(self, bundle, folder, far, **options):
        self.far = far
        self.link = Link(open_buses(f"unix:{folder}"), pump=far.serve, reply_id=bundle.settings["can"]["reply_id"])
        self.runtime = Runtime(bundle, self.link, **options)

    def run(self, ticks, request=Request.NONE, values=(0.0, 0.0, 0.0), late=0.0):
        """Advance some ticks, the first with a request; return the records."""
        records = [self.runtime.tick(request, values, late).copy()]
        return records + [self.runtime.tick(late=late).copy() for _ in range(ticks - 1)]

    def enable(self, ticks=6):
        """Enable the motors of a robot that stands at rest although they are off, and run some ticks."""
        for _ in range(REST_TICKS):
            self.far.restart()
            self.run(1)
        self.far.restart()
        return self.run(ticks, Request.STAND)

    def stand(self):
        """Enable the motors of a robot that stands already, and hold."""
        self.enable()
        self.runtime._enter(State.HOLD)
        self.run(48)


@pytest.fixture(scope="session")
def simulation():
    """Simulation of the far end, with a physics step a tick."""
    return make_simulation(1.0 / 480.0)


@pytest.fixture
def make_robot(bundle, simulation, tmp_path):
    """Function that makes a robot on simulated buses; arguments: of BusSim and Runtime."""
    robots = []

    def make(faults=None, source=None, **options):
        close()
        far = BusSim(open_buses(f"unix:{tmp_path}", "robot"), faults, sim=simulation)
        options["source"] = MotionCapture() if source is None else source
        robots.append(Robot(bundle, tmp_path, far, **options))
        return robots[-1]

    def close():
        for robot in robots:
            robot.link.close()
            for bus in robot.far.buses:
                bus.shutdown()

    yield make
    close()
