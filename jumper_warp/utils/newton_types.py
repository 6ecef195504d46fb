"""Newton's Model, State and Control; for type checkers of any type, since Newton marks their arrays as optional."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import newton

if TYPE_CHECKING:
    Model = State = Control = Any
else:
    Model, State, Control = newton.Model, newton.State, newton.Control
