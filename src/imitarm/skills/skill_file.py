"""The skill file: human-readable JSON. A skill file is checked when it is read, and nothing in it is ever executed.

The file contains ``format`` and ``version``, the meaning of the numbers (``units``, ``frames``), and their origin
(``task``, ``provenance``). Then come the numbers (``gmr``, ``dmp``, ``fit``) and a ``checksum``. The checksum is the
SHA-256 of the other content, with sorted keys and without spaces. It therefore detects every changed digit, but does
not depend on line breaks and spaces. Floats are written with all digits and are read back exactly. The classes in this
module define the content of the file.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np

from imitarm.errors import FileFormatError, InputError
from imitarm.files.document import as_document, write_text
from imitarm.skills.dmp import DMP
from imitarm.skills.dynamical_systems import Gains
from imitarm.skills.fit_quality import DemonstrationDistance, FitQuality
from imitarm.skills.gmr import GMR
from imitarm.skills.mixture_fitting import Candidate
from imitarm.skills.rotations import QuaternionDMP, RotationReference

FORMAT = "imitarm skill"
VERSION = 2  # 2 added ends and fit; files of version 1 are read as well
_LARGEST = 64 * 2**20  # [bytes] a skill takes about 50 kB
_REMEDY = "the file was altered after it was written; use the original, or learn the skill again"
_UNITS = {"time": "s", "length": "m", "angle": "rad"}
_FRAMES = {
    "positions": "tool tip in the robot's base frame",
    "quaternions": "tool_to_base, in the order w, x, y, z",
    "rotation vectors": "base frame, from the reference rotation",
    "columns of gmr": "t, x, y, z, then the rotation vector where rotation was learned",
}

Count = Annotated[int, msgspec.Meta(ge=0, le=2**53)]
Row = list[float]
Table = list[Row]


class Provenance(msgspec.Struct, omit_defaults=True):
    """Origin of a skill, see ``Skill.provenance_``."""

    imitarm: str
    sources: list[str]
    notes: list[str]
    date: str | None = None


class ReferenceFields(msgspec.Struct):
    """A :class:`RotationReference`."""

    times: Row
    quaternions: Table


class SelectionFields(msgspec.Struct, omit_defaults=True):
    """The results of the search for the number of components, one row for each number that was tried."""

    rows: Table = msgspec.field(name="n_components, bic, aic, bias_rmse_mm")
    held_out_rmse_mm: Row | None = None


class GmrFields(msgspec.Struct, omit_defaults=True):
    """The attributes of a :class:`GMR`, without the trailing underscore."""

    duration: float
    n_demonstrations: Count
    weights: Row
    means: Table
    covariances: list[Table]
    degenerate_axes: list[Count]
    converged: bool
    log_likelihood: float | None = None
    ends: Table | None = None
    reference: ReferenceFields | None = None
    selection: SelectionFields | None = None


class OrientationFields(msgspec.Struct):
    """A :class:`QuaternionDMP`."""

    knots: Row
    coefficients: Table


class DmpFields(msgspec.Struct, omit_defaults=True):
    """The attributes of a :class:`DMP`, without the trailing underscore."""

    duration: float
    stiffness: float
    damping: float
    start: Row
    goal: Row
    start_velocity: Row
    path_length: float
    weights: Table
    progress_weights: Row
    orientation: OrientationFields | None = None


class FitFields(msgspec.Struct, omit_defaults=True):
    """The attributes of a :class:`FitQuality`; each source has a row of distances [m]."""

    distances: Table = msgspec.field(name="rms, largest, start, goal")
    extent: float
    bias: float
    primitive_bias: float
    rotation_extent: float
    rotation_bias: float
    period: float | None = None
    length: float = 1.0


class SkillDocument(msgspec.Struct, omit_defaults=True):
    """A skill file without its checksum."""

    format: str
    version: int
    units: dict[str, str]
    frames: dict[str, str]
    task: str
    provenance: Provenance
    gmr: GmrFields
    dmp: DmpFields
    fit: FitFields | None = None


# ----- from objects to fields and back


def gmr_fields(gmr: GMR) -> GmrFields:
    """Convert a regression to the fields of a skill file."""
    reference = selection = None
    if gmr.reference_ is not None:
        reference = ReferenceFields(gmr.reference_.times.tolist(), gmr.reference_.quaternions.tolist())
    if gmr.selection_:
        rows = [[c.n_components, c.bic, c.aic, c.bias_rmse_mm] for c in gmr.selection_]
        errors = [c.held_out_rmse_mm for c in gmr.selection_]
        selection = SelectionFields(rows, None if np.isnan(errors[0]) else errors)
    return GmrFields(
        gmr.duration_,
        gmr.n_demonstrations_,
        gmr.weights_.tolist(),
        gmr.means_.tolist(),
        gmr.covariances_.tolist(),
        list(gmr.degenerate_axes_),
        gmr.converged_,
        None if np.isnan(gmr.lower_bound_) else gmr.lower_bound_,
        gmr.ends_.tolist(),
        reference,
        selection,
    )


def gmr_of(fields: GmrFields) -> GMR:
    """Build a regression from the fields of a skill file.

    Raises:
        InputError: when a field is out of range.
    """
    reference = None
    if fields.reference is not None:
        reference = RotationReference(np.array(fields.reference.times), np.array(fields.reference.quaternions))
    selection: list[Candidate] = []
    if fields.selection is not None:
        rows = fields.selection.rows
        errors = fields.selection.held_out_rmse_mm or [np.nan] * len(rows)
        if len(errors) != len(rows) or any(len(row) != 4 for row in rows):
            raise InputError("gmr.selection: must have rows of 4 numbers, and one held-out error for each row")
        selection = [Candidate(int(k), bic, aic, e, bias) for (k, bic, aic, bias), e in zip(rows, errors, strict=True)]
    return GMR.from_mixture(
        fields.weights,
        fields.means,
        fields.covariances,
        duration=fields.duration,
        n_demonstrations=fields.n_demonstrations,
        reference=reference,
        ends=fields.ends,
        selection=selection,
        degenerate_axes=fields.degenerate_axes,
        converged=fields.converged,
        lower_bound=np.nan if fields.log_likelihood is None else fields.log_likelihood,
    )


def dmp_fields(dmp: DMP) -> DmpFields:
    """Convert a primitive to the fields of a skill file."""
    orientation = None
    if dmp.orientation_ is not None:
        orientation = OrientationFields(dmp.orientation_.knots_.tolist(), dmp.orientation_.coefficients_.tolist())
    return DmpFields(
        dmp.duration_,
        dmp.gains_.stiffness,
        dmp.gains_.damping,
        dmp.start_.tolist(),
        dmp.goal_.tolist(),
        dmp.start_velocity_.tolist(),
        dmp.path_length_,
        dmp.weights_.tolist(),
        dmp.progress_weights_.tolist(),
        orientation,
    )


def dmp_of(fields: DmpFields) -> DMP:
    """Build a primitive from the fields of a skill file.

    Raises:
        InputError: when a field is out of range.
    """
    gains = Gains(fields.stiffness, fields.damping)
    orientation = None
    if fields.orientation is not None:
        orientation = QuaternionDMP.from_spline(fields.orientation.knots, fields.orientation.coefficients, gains)
    return DMP.from_weights(
        fields.weights,
        fields.progress_weights,
        gains=gains,
        start=fields.start,
        goal=fields.goal,
        start_velocity=fields.start_velocity,
        duration=fields.duration,
        path_length=fields.path_length,
        orientation=orientation,
    )


def fit_fields(fit: FitQuality) -> FitFields:
    """Convert the measures of a fit to the fields of a skill file."""
    return FitFields(
        [[d.rms, d.largest, d.start, d.goal] for d in fit.distances],
        fit.extent,
        fit.bias,
        fit.primitive_bias,
        fit.rotation_extent,
        fit.rotation_bias,
        fit.period,
        fit.length,
    )


def fit_of(fields: FitFields, sources: list[str], n_components: int) -> FitQuality:
    """Build the measures of a fit from the fields of a skill file.

    Raises:
        InputError: when the number of rows of distances differs from the number of sources.
    """
    if len(fields.distances) != len(sources) or any(len(row) != 4 for row in fields.distances):
        raise InputError(f"fit: needs one row of 4 distances for each of the {len(sources)} sources")
    distances = tuple(DemonstrationDistance(s, *row) for s, row in zip(sources, fields.distances, strict=True))
    rest = {name: getattr(fields, name) for name in fields.__struct_fields__ if name != "distances"}
    return FitQuality(distances, n_components, **rest)


# ----- from fields to a file and back


def write_skill(
    path: str | os.PathLike[str], task: str, provenance: Mapping[str, Any], gmr: GMR, dmp: DMP, fit: FitQuality | None
) -> None:
    """Write a skill file. An existing file stays intact until the new one is complete.

    Raises:
        InputError: when a number is not finite, or the file can't be written.
    """
    document = SkillDocument(
        FORMAT,
        VERSION,
        _UNITS,
        _FRAMES,
        task,
        Provenance(**provenance),
        gmr_fields(gmr),
        dmp_fields(dmp),
        None if fit is None else fit_fields(fit),
    )
    whole = msgspec.to_builtins(document)
    try:
        whole["checksum"] = _checksum(whole)
    except ValueError as error:
        raise InputError(f"can't write skill file {path}: it holds a number that is not finite") from error
    write_text(path, "".join(_lines(whole, "")) + "\n")


def read_skill(path: str | os.PathLike[str]) -> SkillDocument:
    """Read and check a skill file.

    Raises:
        InputError: when the file does not exist or can't be read.
        FileFormatError: when the file is not a skill file, was cut or altered, or has an unknown version.
    """
    source = Path(path)
    try:
        if source.stat().st_size > _LARGEST:
            raise FileFormatError(f"{source}: larger than {_LARGEST // 2**20} MB, so it is not a skill file")
        data = source.read_bytes()
    except (OSError, ValueError) as error:
        if isinstance(error, FileFormatError):
            raise
        raise InputError(f"can't read skill file {source}: {getattr(error, 'strerror', None) or error}") from error
    try:
        whole = json.loads(data.decode("utf-8"), object_pairs_hook=_without_repeats, parse_constant=_refuse)
    except (ValueError, RecursionError) as error:  # bad UTF-8, bad JSON, a number of thousands of digits
        raise FileFormatError(
            f"{source}: not readable as JSON ({error}); the file was cut or altered, or is not a skill file"
        ) from error
    if not isinstance(whole, dict) or whole.get("format") != FORMAT:
        raise FileFormatError(f"{source}: not a skill file (its 'format' is not {FORMAT!r})")
    version = whole.get("version")
    if type(version) is not int or version < 1:
        raise FileFormatError(f"{source}, version: must be a whole number above 0, is {version!r:.80}; {_REMEDY}")
    if version > VERSION:
        raise FileFormatError(
            f"{source}: written in version {version} of the format; this imitarm reads versions up to {VERSION}. "
            "Update imitarm"
        )
    checksum = whole.pop("checksum", None)
    try:
        expected = _checksum(whole)
    except (ValueError, RecursionError) as error:
        raise FileFormatError(f"{source}: holds a value that is not allowed in a skill file ({error})") from error
    if checksum != expected:
        raise FileFormatError(f"{source}: the checksum does not match the content; {_REMEDY}")
    return as_document(whole, SkillDocument, source, _REMEDY)


def _without_repeats(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    names = dict(pairs)
    if len(names) < len(pairs):
        raise ValueError("a field occurs twice")
    return names


def _refuse(constant: str) -> float:
    raise ValueError(f"{constant} is not a number")


def _checksum(whole: Mapping[str, Any]) -> str:
    canonical = json.dumps(whole, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return "sha256:" + hashlib.sha256(canonical.encode("ascii")).hexdigest()


def _lines(value: Any, indent: str) -> Iterator[str]:
    """Yield the lines of the JSON text: one line for each field of a group, and one for each row of a table."""
    deeper = indent + "  "
    if isinstance(value, dict) and value:
        items = [(f"{deeper}{json.dumps(k)}: ", v) for k, v in value.items()]
    elif isinstance(value, list) and any(isinstance(v, list | dict) for v in value):
        items = [(deeper, v) for v in value]
    else:
        yield json.dumps(value, allow_nan=False)
        return
    opening, closing = ("{", "}") if isinstance(value, dict) else ("[", "]")
    yield opening + "\n"
    for i, (head, v) in enumerate(items):
        yield head
        yield from _lines(v, deeper)
        yield ",\n" if i < len(items) - 1 else "\n"
    yield indent + closing
