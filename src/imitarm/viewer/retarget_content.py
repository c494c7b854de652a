"""What a report of retargetings says: plain, frozen results of one recording by one or several methods."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from imitarm.capture.skeleton import Skeleton
from imitarm.errors import InputError
from imitarm.retarget import Correspondence, Retargeting
from imitarm.scene import Scene


@dataclass(frozen=True)
class Measure:
    """A number that tells how good a retargeting is.

    Attributes:
        label: what people read.
        value: in ``unit``; nan when not known.
        unit: as it is shown.
        digits: after the point.
        better: whether ``"less"`` or ``"more"`` is better; ``""``: neither.
        fault: whether anything above 0 is a fault, so that it is marked.
    """

    label: str
    value: float
    unit: str = ""
    digits: int = 1
    better: Literal["less", "more", ""] = ""
    fault: bool = False


@dataclass(frozen=True)
class PlainTable:
    """A table of texts: ``title``, a heading for each column, rows of as many cells, a ``caption``."""

    title: str
    heads: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    caption: str = ""


@dataclass(frozen=True, eq=False)
class MethodResult:
    """What one method made of a recording.

    Attributes:
        name: short and unique in the report.
        title: what people read on the tab.
        run: what it did.
        measures: of it; every method has the same ones in the same order.
        tables: more, for this method's tab.
        notes: sentences on what the reader should know of this run.
        caption: a sentence on the method.
        clock: for each sample of the run when the person did it, since the first skeleton, shape (n,) [s]; None: then.
    """

    name: str
    title: str
    run: Retargeting
    measures: Sequence[Measure] = ()
    tables: Sequence[PlainTable] = ()
    notes: Sequence[str] = ()
    caption: str = ""
    clock: NDArray[np.float64] | None = None


@dataclass(frozen=True, eq=False)
class RetargetReport:
    """One recording of a person, and what the methods made of it.

    Attributes:
        title: of the page.
        methods: at least one; the first is the one that the headline is about.
        skeletons: of the person, as the methods got them.
        correspondence: what of the person stands for what of the robot.
        verdict: the result in one line.
        good: whether it is a good one.
        tiles: the numbers that matter most.
        scene: what is in the robot's way.
        summary: a sentence or two on what this is about.
        findings: what was done to the recording or is wrong with it, a sentence each.
        provenance: what is needed to do it again, by name.

    Raises:
        InputError: when there is no method or no skeleton, a name is used twice, or measures differ.
    """

    title: str
    methods: Sequence[MethodResult]
    skeletons: Sequence[Skeleton]
    correspondence: Correspondence
    verdict: str
    good: bool
    tiles: Sequence[Measure] = ()
    scene: Scene = field(default_factory=Scene)
    summary: str = ""
    findings: Sequence[str] = ()
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        names = [method.name for method in self.methods]
        if not names or not self.skeletons:
            raise InputError("RetargetReport: needs at least one method and one skeleton")
        if len(set(names)) < len(names):
            raise InputError(f"RetargetReport: method names must be unique, got {names}")
        labels = [[measure.label for measure in method.measures] for method in self.methods]
        if any(mine != labels[0] for mine in labels):
            raise InputError("RetargetReport: every method needs the same measures in the same order")
