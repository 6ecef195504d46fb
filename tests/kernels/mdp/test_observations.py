import numpy as np

from jumper_warp.kernels.mdp import observations as terms
from jumper_warp.tasks.cfg import ObservationsCfg
from jumper_warp.tasks.terms import ObservationTerm
from mdp_helpers import DEFAULT_ANGLE, write
from probe_task import Probe, probe_task

N = 16
TERMS = (terms.contacts, terms.air_times, terms.paw_forces, terms.height, terms.angle)  # 4, 4, 4, 1, 12 columns


def test_terms_of_paws_height_and_sensors_equal_the_stored_arrays():
    observations = ObservationsCfg(actor=tuple(ObservationTerm(term) for term in TERMS), critic=())
    probe = Probe(N, probe_task(observations=observations))
    rng = np.random.default_rng(0)
    down, air = rng.random((4, N)) < 0.5, rng.random((4, N)).astype(np.float32)
    force = 300.0 * rng.normal(size=(4, N, 3)).astype(np.float32)
    offset, height = rng.normal(size=(12, N)).astype(np.float32), rng.uniform(0.2, 1.0, N).astype(np.float32)
    probe.robot.contact_time.assign(down / 60.0)
    probe.robot.air_time.assign(air)
    probe.robot.paw_force.assign(force)
    probe.robot.joint_offset.assign(offset)
    write(probe.robot.joint_q, slice(2, None, 43), height)  # z of each base
    probe.observe()
    obs = probe.obs("actor")
    np.testing.assert_array_equal(obs[:, :4], down.T)
    np.testing.assert_array_equal(obs[:, 4:8], air.T)
    expected_force = np.minimum(np.linalg.norm(force, axis=2).T / 140.0, 5.0)  # 140 N: weight of the robot
    np.testing.assert_allclose(obs[:, 8:12], expected_force, rtol=1e-5)
    np.testing.assert_array_equal(obs[:, 12], height)
    sensed_angle = np.float32(DEFAULT_ANGLE) + offset.T
    np.testing.assert_allclose(obs[:, 13:], sensed_angle - np.float32(DEFAULT_ANGLE), atol=1e-6)
