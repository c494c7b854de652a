"""The methods that the mapping benchmark compares, by the name of the row they get in its tables."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from imitarm.errors import UnknownNameError
from imitarm.kinematics.arm import ArmModel
from imitarm.retarget import RETARGETERS, Correspondence, Retargeter


@dataclass(frozen=True)
class Method:
    """A row: a method with its options.

    Attributes:
        retargeter: its name in :data:`imitarm.retarget.RETARGETERS`.
        label: of the row; empty: the method's own title.
        options: for its constructor.
    """

    retargeter: str
    label: str = ""
    options: Mapping[str, Any] = field(default_factory=dict)

    @property
    def title(self) -> str:
        """The label of the row in tables and figures."""
        return self.label or RETARGETERS[self.retargeter].title

    def __call__(self, arm: ArmModel, correspondence: Correspondence, *, dt: float = 0.01) -> Retargeter:
        """Return the retargeter for this arm and this person."""
        return RETARGETERS[self.retargeter](arm, correspondence, dt=dt, **self.options)


MAIN: Mapping[str, Method] = {name: Method(name) for name in RETARGETERS}
"""Every registered method with its default options. The built-in ones are those of the thesis's Table 3.1 and Figs 3.6
to 3.8: ``thesis`` is its own method with corrected equations, M1 to M3 are our reading of what it compares with, and
``modern`` is the method of this package. Methods of other packages are added by entry points."""

VARIANTS: Mapping[str, Method] = {
    "me-thesis": Method("thesis", "Me-thesis", {"smoothing": "global", "small_angle": "thesis"}),
    "thesis-global": Method("thesis", "thesis, global", {"smoothing": "global"}),
    "thesis-small-angle": Method("thesis", "thesis, small angle", {"small_angle": "thesis"}),
    "thesis-printed": Method("thesis", "thesis, as printed", {"as_printed": True}),
    "m1-scaled": Method("m1", "M1, scaled", {"velocity_scaling": True}),
    "m3-scaled": Method("m3", "M3, scaled", {"velocity_scaling": True}),
}
"""The same methods with one option changed, to show its effect. Me-thesis has one NURBS for the whole recording and the
small-angle term; "as printed" has every misprint that can be run; "scaled" slows all joints together where one would be
too fast."""

METHODS: Mapping[str, Method] = {**MAIN, **VARIANTS}
"""All rows by name."""


def method(name: str) -> Method:
    """Return a method by name.

    Raises:
        UnknownNameError: when there is none; the message lists those that exist.
    """
    if name not in METHODS:
        raise UnknownNameError.among("method", name, METHODS)
    return METHODS[name]
