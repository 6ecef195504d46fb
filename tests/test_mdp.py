"""Module `mdp`: its public names, and that scripts and documents import it in place of kernels."""

import warp as wp

import hold_height
from jumper_warp import mdp


def test_curriculum_counts_every_episode_by_default():
    curriculum = mdp.Curriculum(hold_height.height_error, tolerance=0.1)
    assert curriculum.options["counts"].func(None) is True


def test_every_public_name_resolves_and_namespaces_hold_stock_functions():
    assert len(mdp.__all__) == len(set(mdp.__all__))
    assert all(getattr(mdp, name) is not None for name in mdp.__all__)
    for term in (mdp.rewards.action_rate, mdp.terminations.tilted, mdp.observations.angle, mdp.events.base_mass):
        assert isinstance(term, wp.Function)
