import numpy as np

from jumper_warp.kernels.mdp import observations as obs
from jumper_warp.tasks.cfg import ObservationsCfg
from jumper_warp.tasks.terms import ObservationTerm
from mdp_helpers import DEFAULT_ANGLE, write
from probe_task import Probe, probe_task

N = 16
TERMS = (obs.contacts, obs.air_times, obs.paw_forces, obs.height, obs.angle)


def test_paws_and_sensors_are_seen_as_they_are_stored():
    seen = ObservationsCfg(actor=tuple(ObservationTerm(term) for term in TERMS), critic=())
    probe = Probe(N, probe_task(observations=seen))
    rng = np.random.default_rng(0)
    down, air = rng.random((4, N)) < 0.5, rng.random((4, N)).astype(np.float32)
    force = 300.0 * rng.normal(size=(4, N, 3)).astype(np.float32)
    offset, height = rng.normal(size=(12, N)).astype(np.float32), rng.uniform(0.2, 1.0, N).astype(np.float32)
    probe.robot.contact_time.assign(down / 60.0)
    probe.robot.air_time.assign(air)
    probe.robot.paw_force.assign(force)
    probe.robot.joint_offset.assign(offset)
    write(probe.robot.joint_q, slice(2, None, 43), height)
    probe.observe()
    found = probe.obs("actor")
    np.testing.assert_array_equal(found[:, :4], down.T)
    np.testing.assert_array_equal(found[:, 4:8], air.T)
    np.testing.assert_allclose(found[:, 8:12], np.minimum(np.linalg.norm(force, axis=2).T / 140.0, 5.0), rtol=1e-5)
    np.testing.assert_array_equal(found[:, 12], height)
    read = np.float32(DEFAULT_ANGLE) + offset.T
    np.testing.assert_allclose(found[:, 13:], read - np.float32(DEFAULT_ANGLE), atol=1e-6)
