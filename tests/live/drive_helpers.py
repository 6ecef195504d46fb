"""Sessions of driven robots for tests."""

from jumper_warp.evaluation.conditions import Conditions
from jumper_warp.live.session import Session, load

CPU = Conditions(device="cpu", threads=1)


def session_of(*names, agent="policy", conditions=CPU):
    """Return a session of policies, or of other sources for another agent."""
    recipes, policies = zip(*(load(name, agent) for name in names), strict=True)
    return Session(recipes, policies, conditions, agent=agent)
