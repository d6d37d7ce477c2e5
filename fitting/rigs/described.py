"""Relaxation and creep tests under loadings other than simple shear.

A small TOML file describes the test, the sample and its rig (the test machine). f(d) is the force on an elastic sample
of unit shear modulus at a displacement d. For glued samples, f(d) is computed by finite elements and corrected for the
estimated error of the mesh. In a slender sample, the stretch is taken as uniform. For indenters, f(d) is the exact
solution for a layer that is bonded to a rigid base. The force on the viscoelastic sample follows from linear
viscoelasticity with the relaxation modulus G. Here f(d) takes the place of the strain:

    F(t) = integral of G(t - s) d f(d(s)).

This formula is exact if strains are small, and if the bulk modulus relaxes like the shear modulus or is much larger
than the shear modulus. For an indenter, the formula is valid only while the contact grows (Lee and Radok 1960, J. Appl.
Mech. 27:438). At large strain, the formula is an approximation: Fung's quasi-linear viscoelasticity.
"""

import tomllib
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy.ndimage

from fitting.readers.checks.course_in_time import BEYOND_NOISE
from fitting.readers.checks.scattering_load import without_scatter
from fitting.readers.noise_of_series import noise_of_series
from fitting.readers.tables.time_columns import read_columns
from fitting.readers.time_tests import AT_REST, TimeTest, from_rest, of_columns, with_known_rise
from fitting.rigs import glued, thin_layer
from fitting.rigs.compression import smooth_force
from liverjax.core.bounds import finite
from liverjax.core.did_you_mean import hint
from liverjax.core.errors import InputError
from liverjax.core.status import NAMES, most_severe
from liverjax.laws import NeoHookean

#: Sizes that each test needs: lengths [m], and the half angle [degrees] of the cone.
TESTS: dict[str, tuple[str, ...]] = {
    "tension": ("radius", "height"),
    "compression": ("radius", "height"),
    "glued_punch": ("radius", "height", "punch"),
    "sphere": ("radius", "thickness"),
    "cone": ("half_angle", "thickness"),
    "punch": ("radius", "thickness"),
}
_OTHER = ("test", "data", "drive", "poisson", "min_time", "ramp")
#: Kind of the test for each imposed quantity.
_KINDS = {"displacement": "relaxation", "force": "creep"}
#: Default Poisson's ratios: _GLUED for glued samples (K/mu = 1000), and _LAYER for layers (incompressible).
_GLUED, _LAYER = 0.4995, 0.5
#: Displacements, divided by the largest displacement, at which glued samples are simulated. Above the strain _LARGE,
#: the finer grid is used.
_GRID, _FINER_GRID, _LARGE = (0.05, 0.5, 1.0), (0.05, 0.25, 0.5, 0.75, 1.0), 0.1
#: Sizes of the cells at the rims of the plates, divided by the shortest dimension of the sample there. The simulation
#: is tried with the small cells first. They are more accurate, but may invert at large compression.
_RIMS = (0.04, 0.1, 0.2)
#: An indenter counts as going back if a running median of its depth falls by more than _BACK times the largest depth.
_BACK = 0.02
#: The fall must also exceed the falls that the scatter of the depth causes. The limit is the largest expected deviation
#: of a row, times _FALL for a median over _ROWS rows. For a median over more rows, the limit is _FALL_WIDE times this
#: deviation, divided by the root of the number of rows. The values were found with simulated scatter.
_ROWS, _FALL, _FALL_WIDE = 5, 1.5, 3.0
#: The median over more rows covers at most the fraction _WIDE of all rows, and at most _WIDEST rows.
_WIDE, _WIDEST = 0.05, 500
#: A punch that goes back has lost the contact if its force is below AT_REST times the largest force, or below
#: _NO_FORCE standard deviations of the noise of the force.
_NO_FORCE = 3.0
#: The depth of this punch must also exceed a fraction of its largest depth. This fraction is _DEEP times the limit of
#: the force, divided by the largest force, but at most _DEEPEST.
_DEEP, _DEEPEST = 5.0, 0.5
#: The direction of an indentation is found from the rows in which the force exceeds this fraction of the largest force.
_PRESSED = 0.5
#: Minimum number of rows in which the contact grows, including the row at rest.
_FEWEST = 6
#: Maximum number of rows of an indenter's test, including the rows that are added between the measured rows.
_MOST_ROWS = 2000
#: Relative change of a size of the sample, for derivatives with respect to this size.
_STEP = 0.01
#: Glued samples are simulated up to this ratio of height to radius. Above this ratio, a simulation would need a large
#: mesh and take minutes, so the stretch is taken as uniform.
_SLENDER = 10.0
#: The glued ends make a slender sample stiffer. Its stiffness is that of a sample with frictionless ends that is
#: shorter by this number times (2 nu)^2 radii (nu: Poisson's ratio). With this value, the stiffness is within 0.2 % of
#: that of simulated samples of 10 and 25 radii.
_SHORTER = 0.325
#: Displacements of a glued sample against its load are only computed if they exceed this fraction of the height.
_REVERSED = 0.02
#: A note is given if the relative deviation of the force from a straight line exceeds this value.
_CURVED = 0.02


class Described(NamedTuple):
    """The content of a TOML file that describes a test."""

    test: str
    data: Path
    sizes: dict[str, float]
    poisson: float
    drive: str  # imposed quantity: displacement or force
    min_time: float
    at_once: bool  # whether the file has ramp = 0: the load of the first row acted from 0 s on


def read_described(path: str | Path) -> TimeTest:
    """Read the described test and convert it to a test in shear, with the strain f(d)/S and the stress F/S. F is the
    measured force. The area S is chosen so that a small strain equals d divided by the height or thickness of the
    sample. For sphere and cone, this is so for the largest strain instead.

    Args:
        path: TOML file with the keys test, data (file with a table of time, displacement and force), and the sizes in
            metres that the test needs. The keys drive, poisson, min_time and ramp (only 0) are optional.

    Raises:
        InputError: the description or its data cannot be used. The message names the file, the key, the value and the
            remedy.
    """
    path = Path(path)
    described = _description(path)
    needed = ("displacement", "force")
    columns, notes = read_columns(described.data, needed)
    for name in needed:
        if name not in columns:
            raise InputError(
                f"{described.data}: the test in {path.name} needs columns of time, displacement and force; this file "
                f"has {', '.join(columns)}"
            )
    d, force = columns["displacement"], columns["force"]
    if described.test == "compression":
        notes.append("displacement and force are assumed to be positive in compression")
    sign = _sign_of_load(described, d, force)
    if described.test == "tension" and sign < 0:
        notes.append(
            "the displacement is negative, and is taken as the length by which the sample is pulled. If the sample was "
            "pressed, write test = 'compression'"
        )
    largest = float(np.max(sign * d))
    if not largest > 0:
        raise InputError(f"{described.data}: the displacement is zero throughout; give a test with a displacement")
    curve, size, told = _elastic(described, (largest, float(np.max(-sign * d))), str(path))
    if "thickness" in described.sizes and described.drive == "displacement":
        d = _from_contact(d, sign, largest)
    section = curve(largest * 1e-3) / (1e-3 * largest / size)
    if described.test in ("sphere", "cone"):
        section = curve(largest) / (largest / size)
    first, then = (d, force) if described.drive == "displacement" else (force, d)
    ramp, (own_time, own_drive) = 0.0 if described.at_once else None, (columns["time"], first)
    time, first, then, told_of_start = from_rest(own_time, first, then, ramp, (str(described.data), "ramp"))
    (time, d, force), told_of_rows = _rows_to_fit(described, (time, first, then), sign)
    # Without contact, an indenter has no force.
    moved = sign * d if "height" in described.sizes else np.maximum(sign * d, 0.0)
    strain, stress = curve_of(curve, moved) / section, sign * force / section
    kind = _KINDS[described.drive]
    driven, answer = (strain, stress) if kind == "relaxation" else (stress, strain)
    notes = [*notes, *told, *told_of_start, *told_of_rows]
    test = of_columns(kind, time, driven, answer, (str(path), notes), described.min_time)
    per_size = _change_per_size(described, largest)
    return with_known_rise(test, own_time, own_drive, ramp)._replace(described=True, per_size=per_size)


def _sign_of_load(described: Described, d: np.ndarray, force: np.ndarray) -> float:
    """Return the sign (1 or -1) of the displacement d (n,) that loads the sample. An indenter may move further before
    the contact than in the sample. So for an indenter, only rows with a large force count. If these are all rows, or
    have no displacement, the force before the first movement is subtracted as an offset."""
    pressed = 0.0
    if "thickness" in described.sizes:
        still = int(np.argmax(np.abs(d - d[0]) > AT_REST * np.ptp(d)))
        for offset in (0.0, np.median(force[: max(still, 1)])):
            large = np.abs(force - offset) >= _PRESSED * np.max(np.abs(force - offset))
            pressed = float(np.median(d[large]))
            if not large.all() and abs(pressed) > AT_REST * np.max(np.abs(d)):
                break
    return float(np.sign(pressed or d[np.argmax(np.abs(d))])) or 1.0


def _from_contact(d: np.ndarray, sign: float, largest: float) -> np.ndarray:
    """Return the displacements d (n,) of an indenter, with 0 in the rows before contact. If the negative values of d
    are only scatter around 0, d is not changed, because the mean of the scatter must stay 0."""
    approach = -float(np.min(sign * d))
    if approach <= max(AT_REST * largest, BEYOND_NOISE * noise_of_series(d)):
        return d
    return sign * np.maximum(sign * d, 0.0)


def _rows_to_fit(
    described: Described, rows: tuple[np.ndarray, np.ndarray, np.ndarray], sign: float
) -> tuple[tuple[np.ndarray, ...], list[str]]:
    """Return time, displacement and force of the fitted rows, and notes. The scatter of the imposed quantity is
    removed. For sphere and cone, rows after the indenter goes back are left out. If the displacement is imposed, rows
    are added for sphere and cone, and rows after a punch loses the contact are left out.

    Args:
        described: the description of the test.
        rows: time, imposed quantity and response (n,).
        sign: sign of the displacement that loads the sample.

    Raises:
        InputError: the indenter goes back almost from the beginning.
    """
    time, first, then = rows
    by_displacement = described.drive == "displacement"
    notes: list[str] = []
    if described.test in ("sphere", "cone"):
        kept, notes = _while_contact_grows(time, sign * (first if by_displacement else then))
    elif described.test == "punch" and by_displacement:
        kept, notes = _while_punch_presses(time, sign * first, sign * then)
    else:
        kept = len(time)
    if kept < min(_FEWEST, len(time)):
        raise InputError(
            f"{described.data}: the indenter goes back from {time[kept]:.4g} s on, after {kept} rows; give a test "
            "that begins with an indentation"
        )
    time, first, then = time[:kept], first[:kept], then[:kept]
    # This is done before rows are added, because added rows lie on straight lines and would hide the scatter.
    first, told = without_scatter(time, first, described.drive)
    d, force = (first, then) if by_displacement else (then, first)
    if described.test in ("sphere", "cone") and by_displacement:
        time, d, force = _with_more_between(time, d, force)
    return (time, d, force), [*notes, *told]


def _while_contact_grows(time: np.ndarray, depth: np.ndarray) -> tuple[int, list[str]]:
    """Return the number of rows before the indenter goes back, and a note if it goes back. While the contact shrinks,
    another formula is valid for the force (Ting 1966, J. Appl. Mech. 33:845)."""
    back = _gone_back(depth)
    if not back.any():
        return len(time), []
    kept = int(np.argmax(back))
    return kept, [
        f"{len(time) - kept} rows from {time[kept]:.4g} s on are ignored, because the indenter goes back there, and "
        "the formulas are not valid while the contact shrinks"
    ]


def _while_punch_presses(time: np.ndarray, depth: np.ndarray, force: np.ndarray) -> tuple[int, list[str]]:
    """Return the number of rows before a punch loses the contact, and a note on this loss. A punch loses the contact if
    it goes back and its force falls to 0 before its depth falls to 0. While a punch presses on the sample, its contact
    does not shrink, so it may go back."""
    loaded = int(np.argmax(depth > AT_REST * depth.max()))
    smooth = scipy.ndimage.median_filter(force, _ROWS, mode="nearest")  # removes single low values
    smooth -= np.median(force[:loaded]) if loaded >= _ROWS else 0.0  # the sensor may have an offset
    least = max(AT_REST * smooth.max(), _NO_FORCE * noise_of_series(force))
    free = _gone_back(depth) & (smooth <= least)
    # Force and depth may fall to 0 together in a cycle. A punch may be lifted between rows: the row before counts too.
    deep = min(_DEEP * least / max(smooth.max(), 1e-300), _DEEPEST) * depth.max()
    free &= np.maximum(depth, np.append(depth[:1], depth[:-1])) > deep
    if not free.any():
        return len(time), []
    kept = int(np.argmax(free))
    return kept, [
        f"{len(time) - kept} rows from {time[kept]:.4g} s on are ignored, because the punch goes back and has no force "
        "there: it does not touch the sample any more"
    ]


def _gone_back(depth: np.ndarray) -> np.ndarray:
    """Return for each row (n,) whether the depth is clearly below the largest depth so far (`_BACK`, `_FALL`)."""
    depth = np.maximum(depth, 0.0)
    # The largest of n values with Gaussian noise is expected at sqrt(2 ln(n)) standard deviations.
    deviation = noise_of_series(depth) * np.sqrt(2 * np.log(len(depth)))
    smooth = scipy.ndimage.median_filter(depth, _ROWS, mode="nearest")  # removes single low values
    least = _BACK * float(smooth.max())
    back = np.maximum.accumulate(smooth) - smooth > max(least, _FALL * deviation)
    # A median over more rows finds smaller falls. With `needed` rows, the falls due to scatter are below `least`.
    needed = (_FALL_WIDE * deviation / max(least, 1e-300)) ** 2
    rows = int(np.clip(needed, _ROWS, max(_ROWS, min(_WIDE * len(depth), _WIDEST)))) | 1  # an odd number
    smooth = scipy.ndimage.median_filter(depth, rows, mode="reflect")
    back |= np.maximum.accumulate(smooth) - smooth > max(least, _FALL_WIDE * deviation / np.sqrt(rows))
    return back


def _with_more_between(time: np.ndarray, d: np.ndarray, force: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return time, displacement d and force with additional rows between the measured rows. The additional rows have no
    force (NaN). They are needed because d is linear in time between two measured rows, but f(d) is not."""
    parts = int(np.clip(_MOST_ROWS // len(time), 1, 8))
    place = np.arange((len(time) - 1) * parts + 1) / parts
    rows = np.arange(len(time))
    more = np.full(len(place), np.nan)
    more[::parts] = force
    return np.interp(place, rows, time), np.interp(place, rows, d), more


def curve_of(curve: Callable[[float], float], d: np.ndarray) -> np.ndarray:
    """Return the elastic force per unit shear modulus f(d) (n,) [m^2] at displacements d (n,) [m]. It is interpolated
    between many values of `curve`, and is 0 at d = 0."""
    sides = np.linspace(min(float(d.min()), 0.0), 0.0, 400), np.linspace(0.0, max(float(d.max()), 0.0), 400)
    grid = np.unique(np.concatenate(sides))
    return np.interp(d, grid, [curve(each) if each else 0.0 for each in grid])


def _description(path: Path) -> Described:
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror}): give a TOML file that describes a test") from None
    except ValueError as error:  # wrong TOML or text encoding, or an integer with more digits than Python reads
        raise InputError(f"{path} is not valid TOML ({error}): correct this line") from None
    test = table.get("test")
    if test not in tuple(TESTS):  # the value may be a list, which cannot be looked up in a dictionary
        raise InputError(f"{path}: test = {test!r} is not known: {hint(str(test), TESTS)}")
    needed, known = TESTS[test], (*_OTHER, *TESTS[test])
    for key in table:
        if key not in known:
            raise InputError(f"{path}: {test} has no key {key!r}: {hint(key, known)}")
    for key in ("data", *needed):
        if key not in table:
            unit = {"data": "", "half_angle": " in degrees"}.get(key, " in metres")
            raise InputError(f"{path}: {test} needs {key}; give this key{unit}")
    sizes = {key: _number_of(path, key, table[key]) for key in needed}
    bad = next((key for key, value in sizes.items() if not 0 < value < (90 if key == "half_angle" else 1)), None)
    if bad:
        raise InputError(
            f"{path}: {bad} = {sizes[bad]:g} cannot be the size of a sample; give metres (half_angle: degrees)"
        )
    own = _LAYER if "thickness" in needed else _GLUED
    poisson = _number_of(path, "poisson", table.get("poisson", own))
    if not 0 <= poisson <= own:
        raise InputError(f"{path}: poisson = {poisson:g} must be from 0 to {own:g}; leave it out for soft tissue")
    if not isinstance(table["data"], str):
        raise InputError(f"{path}: data = {table['data']!r} must name a file; write data = 'test.csv'")
    drive = table.get("drive", "displacement")
    if drive not in tuple(_KINDS):
        raise InputError(f"{path}: drive = {drive!r} is not known; use displacement or force")
    first = _number_of(path, "min_time", table.get("min_time", 0.0))
    if first < 0:
        raise InputError(
            f"{path}: min_time = {first:g} is negative; give a time of the data file in seconds, 0 or more"
        )
    ramp = table.get("ramp")
    if ramp is not None and _number_of(path, "ramp", ramp) != 0:
        raise InputError(
            f"{path}: ramp = {ramp} cannot be used; remove ramp, or give ramp = 0 if the load was a step and no row "
            "shows its rise"
        )
    return Described(test, path.parent / table["data"], sizes, poisson, drive, first, ramp is not None)


def _number_of(path: Path, key: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not finite(value):
        raise InputError(f"{path}: {key} = {value!r} is not a number; give a number")
    return float(value)


def _elastic(
    described: Described, reach: tuple[float, float], path: str
) -> tuple[Callable[[float], float], float, list[str]]:
    """Return the function f(d) [m^2] for unit shear modulus, the length [m] by which d is divided to give a strain, and
    notes. `reach`: largest displacement [m] in the direction of the load, and against it."""
    sizes = described.sizes
    if "thickness" not in sizes:
        return _glued_curve(described, reach, path)
    indenter = thin_layer.Indenter(
        shape=described.test,
        thickness=sizes["thickness"],
        poisson=described.poisson,
        radius=sizes.get("radius", 0.0),
        half_angle=sizes.get("half_angle", 45.0),
    )
    layer, per_shear = thin_layer.Layer(indenter), 2 * (1 + described.poisson)
    layer.force(np.array([reach[0]]))  # raises InputError for depths beyond the table
    said = "the contact is assumed to begin at displacement 0, without adhesion"
    if described.test != "punch":
        said += ", and to grow until the largest displacement"
    return (lambda d: per_shear * float(layer.force(np.array([d]))[0])), sizes["thickness"], [said]


def _change_per_size(described: Described, largest: float) -> tuple[float, float]:
    """Return the relative change of the moduli per metre of the height or thickness, and per metre by which the radius
    decreases. For a glued punch, the radius is that of the punch. The half angle of a cone is assumed to be exact.

    These numbers are only for errors, so approximations are enough for glued samples. The stiffness of a glued cylinder
    is that of Gent and Lindley (1959, Proc. Inst. Mech. Eng. 173:111). A sample under a glued punch is treated as a
    wide layer. It is taken as thicker if the radius of the punch exceeds `thin_layer.WIDEST` heights.
    """
    sizes, test = described.sizes, described.test
    height, radius = sizes.get("thickness", sizes.get("height", 0.0)), sizes.get("punch", sizes.get("radius", 0.0))

    def force(height: float, radius: float) -> float:
        if test in ("tension", "compression"):
            return radius**2 / height * (1 + (radius / height) ** 2 / 2)
        shape = "punch" if test == "glued_punch" else test
        angle = sizes.get("half_angle", 45.0)
        layer = thin_layer.Layer(thin_layer.Indenter(shape, height, described.poisson, radius, angle))
        return float(layer.force(np.array([largest]))[0])

    # A thicker layer and a smaller indenter stay within the table of forces, in which only the ratio of sizes matters.
    used = max(height, radius / thin_layer.WIDEST) if test == "glued_punch" else height
    own, thicker, smaller = force(used, radius), force((1 + _STEP) * used, radius), force(used, (1 - _STEP) * radius)
    by_radius = (1 - smaller / own) / (_STEP * radius) if radius else 0.0
    return (1 - thicker / own) / (_STEP * height), by_radius


def _glued_curve(
    described: Described, reach: tuple[float, float], path: str
) -> tuple[Callable[[float], float], float, list[str]]:
    """Compute f(d) of a glued sample. Takes and returns the same values as `_elastic`."""
    (largest, back), sizes = reach, described.sizes
    radius, height = sizes["radius"], sizes["height"]
    if largest >= 0.5 * height:
        raise InputError(
            f"{path}: the displacement reaches {largest:g} m, which is more than half of the height {height:g} m; "
            "correct the height, or the unit of the displacement"
        )
    slender = height > _SLENDER * radius
    if slender and described.test == "glued_punch":
        raise InputError(
            f"{path}: height = {height:g} m is {height / radius:.3g} radii, but samples under a punch are computed "
            f"only up to {_SLENDER:g} radii; test a shorter sample, or glue the whole end to a plate"
        )
    secants = _secants_of_uniform if slender else _secants
    at, secant, notes = secants(described, largest, path)
    curved = secant[-1] / secant[0] - 1
    if abs(curved) > _CURVED:
        notes.append(
            f"at the largest displacement, the elastic force differs by {100 * curved:+.0f} % from a straight line; "
            "the fit assumes that this force relaxes like the shear stress (quasi-linear)"
        )
    if back > _REVERSED * height:
        try:
            other, reverse, told = secants(described, -back, path)
        except InputError as error:  # `np.interp` below then returns the first secant for this direction
            cause = str(error).removeprefix(f"{path}: ").partition(";")[0]  # without the remedy
            other, reverse, told = at[:0], secant[:0], [f"the force is assumed to be linear there, because {cause}"]
        at, secant = np.concatenate([other[::-1], at]), np.concatenate([reverse[::-1], secant])
        notes += [f"for displacements against the direction of the load: {note}" for note in told if note not in notes]
    return (lambda d: d * float(np.interp(d, at, secant))), height, notes


def _computed_at(end: float, height: float) -> np.ndarray:
    """Return the displacements (k,) [m] up to `end` [m] at which a glued sample is computed."""
    return end * np.array(_GRID if abs(end) <= _LARGE * height else _FINER_GRID)


def _neo_hookean(poisson: float) -> NeoHookean:
    return NeoHookean(mu=1e3, bulk=1e3 * 2 * (1 + poisson) / (3 * (1 - 2 * poisson)))


def _secants_of_uniform(described: Described, end: float, path: str) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Return the same values as `_secants` for a slender sample, whose stretch is uniform."""
    radius, height, poisson = described.sizes["radius"], described.sizes["height"], described.poisson
    at, pressed = _computed_at(end, height), -1.0 if described.test == "tension" else 1.0
    law, shorter = _neo_hookean(poisson), _SHORTER * (2 * poisson) ** 2 * radius
    force = [smooth_force(law, pressed * d / (height - shorter), radius) / 1e3 for d in at]
    note = (
        f"the height of the sample is {height / radius:.3g} radii, so its stretch is taken as uniform. Its glued ends "
        f"count as {100 * shorter / height:.2g} % less height"
    )
    return at, np.abs(force / at), [note]


def _secants(described: Described, end: float, path: str) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Compute a glued sample by finite elements, corrected for the error of the mesh.

    Args:
        described: the description of the test.
        end: last displacement [m]; it is negative against the direction of the load.
        path: path of the description, for messages.

    Returns:
        displacements (k,) [m] from small ones to `end`; f(d) / d (k,) [m]; and notes.
    """
    sizes, way = described.sizes, 1.0 if described.test == "tension" else -1.0
    radius, height = sizes["radius"], sizes["height"]
    at, law = _computed_at(end, height), _neo_hookean(described.poisson)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        for rim in _RIMS:
            said.clear()
            cells = glued.Cells(rim=rim)
            if described.test == "glued_punch":
                rig = glued.indentation(radius, height, sizes["punch"], 1.0, at, cells)
            else:
                rig = glued.tension(radius, height, 1.0, way * at / height, cells)
            force, codes = glued.read(rig, law, None)
            if not np.any(np.asarray(codes)):
                break
        else:
            raise InputError(
                f"{path}: the simulation of an elastic sample (radius {radius:g} m, height {height:g} m) fails before "
                f"the displacement {end:g} m ({NAMES[int(most_severe(codes))]}); check the sizes, or give only "
                "rows of smaller displacements"
            )
        left_out = np.asarray(glued.mesh_error(rig, law, None)) / 1e3
    found = np.asarray(force) / 1e3
    notes = [f"{w.message}" for w in said if issubclass(w.category, UserWarning)]
    share, known = left_out / found, np.isfinite(left_out)
    if not known.all():
        notes.append(
            f"the error of the mesh is unknown at {np.sum(~known)} of {len(at)} displacements: "
            + ("the correction of the nearest other one is used" if known.any() else "no correction is made")
        )
    share = np.interp(np.abs(at), np.abs(at[known]), share[known]) if known.any() else np.zeros(len(at))
    secant = np.abs(found * (1 + share) / at)
    notes.append(
        f"the stiffness of the sample, divided by the shear modulus, is {secant[0]:.4g} m; "
        f"{100 * share[0]:.2g} % of this value is a correction for the error of the mesh"
    )
    return at, secant, notes
