"""The points of a master curve: which of them are used, and which weights they have. Notes on missing laws."""

import numpy as np
import pytest

from fitting.master import master_curve, master_report, shifts, temperature_laws, temperature_sweeps
from fitting.master.temperature_sweeps import AtTemperatures
from fitting.methods import generalised_maxwell
from fitting.methods.generalised_maxwell import Maxwell
from fitting.readers.frequency_sweep import Sweep, without_inertia
from liverjax.core.errors import InputError

pytestmark = pytest.mark.quick_to_compile

TRUTH = Maxwell(np.float64(1000.0), np.array([0.2, 0.2, 0.2, 0.2]), np.array([10.0, 1.0, 0.1, 0.01]))
CELSIUS = np.array([0.0, 20.0, 40.0])


def exact(omega: np.ndarray, factor: float = 1.0, added: float = 0.0) -> Sweep:
    """Return a sweep without noise; `added` times omega^2 is added to G'."""
    storage, loss = generalised_maxwell.moduli(TRUTH, factor * omega)
    return Sweep(omega, storage + added * omega**2, loss, source="a.csv")


def at_temperatures(sweeps: list[Sweep], factors: np.ndarray | None = None) -> AtTemperatures:
    return AtTemperatures(sweeps, 273.15 + CELSIUS[: len(sweeps)], factors)


def joined_with_deviations(points: int, temperatures: int, parts: list[float], repeats: int) -> tuple[Sweep, Sweep]:
    """Return a master curve with standard deviations from some repeats, and the same one with exact deviations."""
    rng, known, estimated = np.random.default_rng(1), [], []
    log_a = np.linspace(-1.5, 1.5, temperatures)
    for k, factor in enumerate(10.0**log_a):
        s, part = exact(factor * np.geomspace(0.3, 30, points)), parts[k % len(parts)]
        known.append(s._replace(storage_sd=part * s.storage, loss_sd=part * s.loss))
        chi = np.sqrt(rng.chisquare(repeats - 1, (2, points)) / (repeats - 1))
        estimated.append(s._replace(storage_sd=part * s.storage * chi[0], loss_sd=part * s.loss * chi[1]))
    return temperature_sweeps.joined(estimated), temperature_sweeps.joined(known)


@pytest.mark.parametrize("parts", [[0.03], [0.005, 0.1]])
@pytest.mark.parametrize(("points", "temperatures"), [(6, 7), (2, 12), (12, 5)])
def test_deviations_of_three_repeats_are_smoothed_in_short_sweeps_too(parts, points, temperatures):
    """Sweeps with fewer than 8 frequencies kept their deviations of three repeats. The errors of a fit were then 1.8
    times too small. Deviations that differ with the temperature must still differ."""
    rough, known = joined_with_deviations(points, temperatures, parts, 3)
    off = np.concatenate([np.log(a / b) for a, b in zip(rough.deviations, known.deviations, strict=True)])
    assert np.std(off) < 0.4  # the given deviations: 0.64
    same = zip(known.deviations, (known.storage_sd, known.loss_sd), strict=True)
    assert all(np.allclose(a, b, rtol=0.01) for a, b in same)


@pytest.mark.parametrize("steep", [0.4, 0.7])
def test_smooth_deviations_of_short_sweeps_are_kept(steep):
    """Deviations that grow with the measured frequency are no scatter, although they form a sawtooth over the shifted
    frequency. They were replaced by a parabola over all frequencies, up to 13 times too large."""
    sweeps = []
    for factor in np.geomspace(0.03, 30, 7):
        measured = np.geomspace(0.3, 30, 6)
        s, part = exact(factor * measured), 0.01 * measured**steep
        sweeps.append(s._replace(storage_sd=part * s.storage, loss_sd=part * s.loss))
    whole = temperature_sweeps.joined(sweeps)
    assert np.allclose(whole.deviations, (whole.storage_sd, whole.loss_sd))


def test_a_temperature_without_usable_points_is_ignored():
    """One temperature outside of the band made the command refuse all."""
    hertz = [(10.0, 100.0), (0.1, 100.0), (0.1, 100.0)]
    sweeps = [exact(2 * np.pi * np.geomspace(*band, 12), a) for band, a in zip(hertz, (100, 10, 1), strict=True)]
    sweeps[0] = sweeps[0]._replace(notes=("note of the reader",))
    found = temperature_sweeps.with_usable_points(at_temperatures(sweeps), (None, 9.0), None, None)
    assert np.allclose(found.temperatures - 273.15, [20, 40]) and len(found.sweeps) == 2
    notes = found.sweeps[0].notes
    assert notes[0] == "note of the reader" and notes[1].startswith("the points at 0 °C are ignored: --min-frequency")
    # With given factors, one frequency at a temperature is enough.
    pairs, given = [exact(np.array([1.0, 3.0]), a) for a in (100, 10, 1)], np.array([100.0, 10.0, 1.0])
    found = temperature_sweeps.with_usable_points(at_temperatures(pairs, given), (None, 0.4), None, None)
    assert [len(s.storage) for s in found.sweeps] == [1, 1, 1]
    pairs[1] = pairs[1]._replace(angular_frequency=np.array([10.0, 30.0]))
    found = temperature_sweeps.with_usable_points(at_temperatures(pairs, given), (None, 0.4), None, None)
    assert np.allclose(found.shift_factors, [100, 1]) and "at 20 °C" in found.sweeps[0].notes[0]
    with pytest.raises(InputError, match=r"a\.csv at 20 °C: .*two or more temperatures, and only 0 °C remains"):
        temperature_sweeps.with_usable_points(at_temperatures(pairs[:2], given[:2]), (None, 0.4), None, None)
    with pytest.raises(InputError, match="--max-frequency -1 is not a frequency"):
        temperature_sweeps.with_usable_points(at_temperatures(sweeps), (None, -1.0), None, None)


def test_a_temperature_where_the_instrument_dominates_is_ignored():
    """The command refused all temperatures, because of one."""
    sweeps, omega = [], np.geomspace(1, 300, 16)
    for a, size in ((100, 1), (10, 1), (1, 1e5)):
        s = exact(omega, a)
        sweeps.append(s._replace(raw={"phase": np.angle(s.storage - size * omega**2 + 1j * s.loss)}))
    found = temperature_sweeps.with_usable_points(at_temperatures(sweeps), (None, None), None, None)
    assert np.allclose(found.temperatures - 273.15, [0, 20])
    assert any("the points at 40 °C are ignored: " in note for note in found.sweeps[0].notes)


def test_the_limit_that_keeps_all_points_is_that_of_all_sweeps():
    """The note named the end of its own sweep. This limit cut the sweeps that were longer."""
    rng, sweeps = np.random.default_rng(0), []
    for a, (low, high), added in ((10, (0.5, 300), 0.5), (1, (0.05, 30), 50.0)):
        s = exact(np.geomspace(low, high, 16), a, added)
        noise = 1 + 0.003 * rng.standard_normal((2, 16))
        sweeps.append(s._replace(storage=noise[0] * s.storage, loss=noise[1] * s.loss))
    found = temperature_sweeps.with_usable_points(at_temperatures(sweeps), (None, None), None, None)
    notes = [note for note in found.sweeps[0].notes if "To keep all points" in note]
    assert len(notes) == 2 and all(note.endswith("give --max-frequency 47.75") for note in notes)


def test_raw_columns_of_one_of_two_joined_sweeps_are_used():
    """If one table had no raw phase, the phases of the other table at this temperature were dropped without a note."""
    omega = np.geomspace(1, 300, 16)
    one, other = exact(omega), exact(omega * 1.01)
    one = one._replace(raw={"phase": np.angle(one.storage - omega**2 + 1j * one.loss), "strain": omega})
    both = temperature_sweeps.joined([one, other])
    assert list(both.raw) == ["phase"] and np.isfinite(both.raw["phase"]).sum() == 16
    shown = without_inertia(both)
    assert np.allclose(shown.inertia, shown.angular_frequency**2, rtol=1e-6)
    assert any("16 of 32 points have an empty cell in the raw columns" in note for note in shown.notes)


def test_raw_columns_of_all_joined_sweeps_are_enough():
    """If only one of two tables had a phase, the torques of the other were not used, and the inertia was not found."""
    omega = np.geomspace(1, 300, 16)
    one, other = exact(omega), exact(omega * 1.01)
    raw = {"torque": omega, "angle": omega}
    both = temperature_sweeps.joined([one._replace(raw=raw | {"phase": omega}), other._replace(raw=raw)])
    assert sorted(both.raw) == ["angle", "torque"] and np.isfinite(both.raw["torque"]).all()


def test_joined_sweeps_name_the_first_file_and_count_the_others():
    """Messages began with the paths of all files."""
    three = [exact(np.array([1.0, 2.0]))._replace(source=f"x, y/{k}.csv") for k in range(3)]
    pair = temperature_sweeps.joined(three[:2])
    assert pair.source == "x, y/0.csv and 1 more file"
    every = temperature_sweeps.joined([pair, three[2], three[2]])
    assert every.source == "x, y/0.csv and 2 more files" and every.files == tuple(s.source for s in three)


@pytest.mark.parametrize("count", [2, 3, 4])
def test_a_missing_law_is_told(count):
    """Nothing said why the table had no line for WLF. At four temperatures, these factors curve to the other side."""
    T = 273.15 + 10.0 * np.arange(count)
    zero, factors = np.zeros(count), -(np.arange(count) ** 2.0)
    found = shifts.Shifts(T, 0, factors, zero, zero, zero, zero, zero + 4, np.zeros((count, count)), 1.0)
    laws = temperature_laws.temperature_laws_of(found)
    table = master_report.shift_table(master_curve.MasterCurve(exact(np.array([1.0, 2.0])), [], found, laws))
    told = ("no law is fitted to 2 temperatures", "WLF needs four temperatures", "WLF is left out")[count - 2]
    assert len(laws) == (count > 2) and table.count("note: ") == 1 and f"note: {told}" in table
