"""Reading sweeps: units, instruments' exports, and one-line messages for everything that cannot be read."""

import json

import numpy as np
import pytest
from conftest import ROOT

from fitting.__main__ import main
from fitting.master.temperature_sweeps import joined
from fitting.readers.frequency_sweep import Sweep
from fitting.readers.rheometer import read_sweep
from liverjax import InputError

HEADER = "frequency_Hz,storage_modulus_Pa,loss_modulus_Pa\n"
ROWS = "0.1,300,30\n1,400,60\n10,500,90\n"


def _write(tmp_path, text, name="sweep.csv", encoding="utf-8"):
    path = tmp_path / name
    path.write_bytes(text.encode(encoding) if isinstance(text, str) else text)
    return path


def test_plain_csv(tmp_path):
    s = read_sweep(_write(tmp_path, "# a comment\n" + HEADER + ROWS + "# the end\n"))
    assert np.allclose(s.angular_frequency, 2 * np.pi * np.array([0.1, 1, 10]))
    assert s.storage.tolist() == [300, 400, 500] and s.loss.tolist() == [30, 60, 90]
    assert s.storage_sd is None and s.notes == ()
    assert all(np.array_equal(a, b) for a, b in zip(s.deviations, (s.storage, s.loss), strict=True))


@pytest.mark.parametrize(
    "header",
    [
        "angular_frequency_rad_s,storage_modulus_kPa,loss_modulus_kPa",
        "angular_frequency_rad_s;storage_modulus_kPa;loss_modulus_kPa",
        "Angular frequency [rad/s]\tStorage modulus [kPa]\tLoss modulus [kPa]",
        "omega (rad/s), G' (kPa), G'' (kPa)",
        "ANGULAR_FREQUENCY_RAD_S,STORAGE_MODULUS_KPA,LOSS_MODULUS_KPA",
        '"Angular Frequency (rad/s)","Storage Modulus (kPa)","Loss Modulus (kPa)"',
    ],
)
def test_units_and_delimiters(tmp_path, header):
    delimiter = max("\t;,", key=header.count)
    text = header + "\n" + ROWS.replace(",", delimiter)
    s = read_sweep(_write(tmp_path, text))
    assert np.allclose(s.angular_frequency, [0.1, 1, 10]) and np.allclose(s.storage, [3e5, 4e5, 5e5])


def test_deviations(tmp_path):
    header = "frequency_Hz,storage_modulus_Pa,storage_modulus_sd_Pa,loss_modulus_Pa,loss_modulus_sd_Pa\n"
    text = header + "1,400,4,60,6\n2,500,5,70,7\n"
    s = read_sweep(_write(tmp_path, text))
    assert s.storage_sd.tolist() == [4, 5] and s.loss_sd.tolist() == [6, 7]
    one = "frequency_Hz,storage_modulus_Pa,storage_sd_Pa,loss_modulus_Pa\n1,400,4,60\n2,500,5,70\n"
    with pytest.raises(InputError, match="give both"):
        read_sweep(_write(tmp_path, one))


def test_sorting_and_repeats_are_said(tmp_path):
    s = read_sweep(_write(tmp_path, HEADER + "10,500,90\n0.1,300,30\n0.1,310,31\n"))
    assert s.storage.tolist() == [300, 310, 500]
    assert any("sorted" in n for n in s.notes) and any(
        "repeated frequencies: 1. Each line counts" in n for n in s.notes
    )


def test_copies_of_lines_count_once(tmp_path):
    """Each copy counted as a measurement. If every line was written twice, the interval of the equilibrium modulus was
    a third shorter. If only some lines are equal, they are repeated measurements with the same rounded numbers.
    """
    lines = [f"{f},{300 + 7 * f},{30 + f},{t}\n" for f, t in ((0.1, "1e-6"), (1, "2e-6"), (10, ""))]
    lines.append("1,307.5,31,2e-6\n")  # a repeated measurement
    head = HEADER.strip() + ",torque_Nm\n"
    once = read_sweep(_write(tmp_path, head + "".join(lines)))
    assert len(once.storage) == 4 and any("repeated frequencies: 1." in n for n in once.notes)
    for copies in (lines, 2 * lines):
        again = read_sweep(_write(tmp_path, head + "".join(lines + copies)))
        assert np.array_equal(np.stack(once[:3]), np.stack(again[:3]))
        assert any(f"{len(copies)} of {4 + len(copies)} points are ignored" in n for n in again.notes)
        assert any("repeated frequencies: 1." in n for n in again.notes)
    rounded = read_sweep(_write(tmp_path, head + "".join(lines + lines[:2])))
    assert len(rounded.storage) == 6 and not any("ignored" in n for n in rounded.notes)


TRIOS = """\
Filename\tliver 3
Instrument name\tDHR-3
rundate\t3/6/2020
[Parameters]
Geometry\tParallel plate
Diameter\t20 mm
[step]
Amplitude sweep - 1
Angular frequency\tStorage modulus\tLoss modulus\tOscillation strain\tStep time
rad/s\tPa\tPa\t%\ts
6.28319\t401\t61\t0.01\t10
6.28319\t400\t60\t0.1\t20
[step]
Frequency sweep - 2
Step time\tAngular frequency\tStorage modulus\tLoss modulus\tTan(delta)
s\trad/s\tMPa\tMPa\t
10\t0.628319\t3e-4\t3e-5\t0.1
20\t6.28319\t4e-4\t6e-5\t0.15
30\t62.8319\t5e-4\t9e-5\t0.18
[step]
Conditioning end
Step time\tTemperature
s\t°C
"""

RHEOCOMPASS = """\
Project:\tLiver\t\t\t
Test:\tFrequency sweep 1\t\t\t
Result:\tFrequency sweep 1\t\t\t

Interval and data points:\t1\t3\t\t
Interval data:\tPoint No.\tAngular Frequency\tStorage Modulus\tLoss Modulus
\t\t\t\t
\t\t[rad/s]\t[Pa]\t[Pa]
\t1\t0,628319\t300\t30
\t2\t6,28319\t400\t60
\t3\t62,8319\t5,0E+2\t90
"""


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "latin-1"])
@pytest.mark.parametrize("text", [TRIOS, RHEOCOMPASS], ids=["trios", "rheocompass"])
def test_instrument_exports(tmp_path, text, encoding):
    s = read_sweep(_write(tmp_path, text, "export.txt", encoding))
    assert np.allclose(s.angular_frequency, 2 * np.pi * np.array([0.1, 1, 10]), rtol=1e-5)
    assert np.allclose(s.storage, [300, 400, 500]) and np.allclose(s.loss, [30, 60, 90])
    if text is TRIOS:
        assert "2 tables" in s.notes[0]


VARIANTS = {
    "sd first": (
        "frequency_Hz,sd_storage_modulus_Pa,storage_modulus_Pa,SD_G''_Pa,loss_modulus_Pa\n1,4,400,6,60\n2,5,500,7,70\n",
        True,
    ),
    "errors": (
        "Frequency (Hz),Storage modulus error (Pa),Storage modulus (Pa),Loss modulus error (Pa),Loss modulus (Pa)\n1,4,400,6,60\n2,5,500,7,70\n",
        True,
    ),
    "other columns first": (
        "Frequency point (1),frequency_index,Frequency (Hz),Storage compliance (1/Pa),storage_temperature_C,Storage modulus (Pa),Loss modulus (Pa)\n1,1,1,9,9,400,60\n2,2,2,9,9,500,70\n",
        False,
    ),
    "numpy": ("# frequency_Hz,storage_modulus_Pa,loss_modulus_Pa\n1,400,60\n2,500,70\n", False),
    "spaces": ("frequency_Hz storage_modulus_Pa  loss_modulus_Pa\n1 400  60\n2 500  70\n".replace("  ", " "), False),
    "primes": ("Frequency [Hz]|G′ [Pa]|G″ [Pa]\n1|400|60\n2|500|70\n", False),
    "quoted": ('"Frequency (Hz)","Storage modulus (Pa)","Loss modulus (Pa)"\n"1","400","60"\n"2","500","70"\n', False),
    "title": (
        "Frequency sweep; Storage modulus; Loss modulus\nfrequency_Hz;storage_modulus_Pa;loss_modulus_Pa\n1;400;60\n2;500;70\n",
        False,
    ),
    "both frequencies": (
        "frequency_Hz,angular_frequency_rad_s,storage_modulus_Pa,loss_modulus_Pa\n1,6.2832,400,60\n2,12.566,500,70\n",
        False,
    ),
    "aborted step": (
        "[step]\nFrequency\tStorage modulus\tLoss modulus\nHz\tPa\tPa\n[step]\nFrequency\tStorage modulus\tLoss modulus\nHz\tPa\tPa\n1\t400\t60\n2\t500\t70\n",
        False,
    ),
    "per second": (
        "Frequency [rad s-1]\tStorage modulus [Pa]\tLoss modulus [Pa]\n6.283185307\t400\t60\n12.566370614\t500\t70\n",
        False,
    ),
}


@pytest.mark.parametrize("name", VARIANTS)
def test_headers_that_laboratories_write(tmp_path, name):
    text, deviations = VARIANTS[name]
    s = read_sweep(_write(tmp_path, text))
    assert np.allclose(s.angular_frequency, 2 * np.pi * np.array([1, 2]), rtol=1e-4)
    assert s.storage.tolist() == [400, 500] and s.loss.tolist() == [60, 70]
    assert (s.storage_sd is not None) == deviations
    if deviations:
        assert s.storage_sd.tolist() == [4, 5] and s.loss_sd.tolist() == [6, 7]


BAD = {
    "empty": ("", "is empty"),
    "blank": ("  \n\n", "is empty"),
    "prose": ("Dear colleague,\nplease find the data attached.\n", "no header names frequency_Hz"),
    "binary": (b"\x89PNG\r\n\0\0\0\0", "not a text file"),
    "no numbers": (HEADER, "no numbers below the header"),
    "no frequency": ("time_s,storage_modulus_Pa,loss_modulus_Pa\n1,2,3\n", "no column for frequency"),
    "no loss": ("frequency_Hz,storage_modulus_Pa\n1,2\n", "no column for loss"),
    "unit": (HEADER.replace("loss_modulus_Pa", "loss_modulus_bar") + ROWS, "unit 'bar' of column loss_modulus_bar"),
    "frequency unit": (HEADER.replace("_Hz", "_rpm") + ROWS, "unit 'rpm'"),
    "negative": (HEADER + ROWS.replace("60", "-60"), "line 3: loss_modulus_Pa = -60 is not positive"),
    "zero": (HEADER + ROWS.replace("60", "0"), "loss_modulus_Pa = 0 is not positive"),
    "nan": (HEADER + ROWS.replace("400", "nan"), "line 3: storage_modulus_Pa is empty"),
    "inf": (HEADER + ROWS.replace("400", "inf"), "is not finite"),
    "negative frequency": (HEADER + ROWS.replace("0.1", "-0.1"), "frequency_Hz = -0.1 is not positive"),
    "text": (HEADER + ROWS.replace("400", "soft"), "line 3: storage_modulus_Pa = 'soft' is not a number"),
    "short row": (HEADER + "0.1,300,30\n1,400\n", "line 3: loss_modulus_Pa is empty; fill this cell"),
    "milli": (HEADER.replace("storage_modulus_Pa", "storage_modulus_mPa") + ROWS, "unit 'mPa'"),
    "angular in Hz": (HEADER.replace("frequency_Hz", "angular_frequency_Hz") + ROWS, "angular frequency in Hz"),
    "disagree": ("angular_frequency_rad_s," + HEADER + "1,1,300,30\n2,2,400,60\n", "disagree"),
    "decimal comma": (HEADER + '"1,5","337,8","34,7"\n', "the file has 1 frequency"),
    "decimal comma bare": (HEADER + "1,5,337,8,34,7\n", "6 cells under 3 headings"),
    "one frequency": (HEADER + "1,300,30\n1,310,31\n1,320,33\n", "at least two different"),
    "huge": (HEADER + ROWS.replace("400", "1e200"), "beyond any measurement"),
    "one point": (HEADER + "1,400,60\n", "give at least two"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_files_get_one_sentence(tmp_path, name):
    content, sentence = BAD[name]
    with pytest.raises(InputError) as caught:
        read_sweep(_write(tmp_path, content))
    message = str(caught.value)
    assert sentence in message and "sweep.csv" in message and "\n" not in message


def test_missing_file_and_folder(tmp_path):
    with pytest.raises(InputError, match="does not exist"):
        read_sweep(tmp_path / "none.csv")
    with pytest.raises(InputError, match="is a folder"):
        read_sweep(tmp_path)
    with pytest.raises(InputError, match="name too long"):
        read_sweep(tmp_path / ("x" * 300))


def test_random_damage_is_refused_or_read_but_never_a_traceback(tmp_path):
    rng = np.random.default_rng(0)
    original = (ROOT / "data" / "lions_mane_frequency_sweep.csv").read_bytes()
    for _ in range(200):
        data = bytearray(original)
        for _ in range(rng.integers(1, 30)):
            k = int(rng.integers(len(data)))
            action = rng.integers(3)
            if action == 0:
                data[k] = int(rng.integers(256))
            elif action == 1:
                del data[k : k + int(rng.integers(1, 200))]
            else:
                data[k:k] = bytes(rng.integers(0, 256, 5, dtype=np.uint8))
        path = _write(tmp_path, bytes(data))
        try:
            sweep = read_sweep(path)
        except InputError as error:
            assert "\n" not in str(error)
        else:
            assert np.all(np.isfinite(sweep.storage)) and np.all(sweep.loss > 0)


def test_shipped_tables_name_their_source():
    for path in sorted((ROOT / "data").glob("*.csv")):
        head = [line for line in path.read_text().splitlines() if line.startswith("#")]
        assert "Source" in " ".join(head) and "Units" in " ".join(head)
    for path in sorted((ROOT / "data").glob("*_frequency_sweep.csv")):
        assert len(read_sweep(path).angular_frequency) >= 16


def test_lions_mane_table_is_the_mean_of_the_raw_sweeps():
    from conftest import SHARED

    folder = SHARED / "data" / "lions_mane"
    if not folder.is_dir():
        pytest.skip("the raw sweeps are not here")
    raw = np.stack([np.loadtxt(f, delimiter=",", skiprows=2) for f in sorted(folder.glob("*.csv"))])
    s = read_sweep(ROOT / "data" / "lions_mane_frequency_sweep.csv")
    assert np.allclose(s.storage, raw[:, :, 1].mean(axis=0), rtol=1e-5)
    assert np.allclose(s.loss_sd, raw[:, :, 2].std(axis=0, ddof=1), rtol=1e-5)


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "latin-1"])
def test_any_encoding_is_read(tmp_path, encoding):
    text = "Frequency [Hz];G' [kPa];G'' [kPa];T [°C]\n0,5;1,25;0,5;20\n1;1,5;0,6;20\n2;1,75;0,7;20\n"
    (tmp_path / "a.csv").write_bytes(text.encode(encoding))
    s = read_sweep(tmp_path / "a.csv")
    assert s.storage.tolist() == [1250, 1500, 1750] and s.loss.tolist() == [500, 600, 700]
    assert s.raw is not None and np.allclose(s.raw["temperature"], 293.15)


def test_deviations_are_smoothed_in_each_of_several_joined_sweeps():
    """Deviations of 0.5 and 10 % in two sweeps were smoothed together, and both sweeps had nearly equal weights."""
    omega, own = np.geomspace(0.5, 80, 12), []
    for k, error in enumerate((0.005, 0.1)):
        G = 1000 * omega**0.3, 300 * omega**0.3
        own.append(Sweep(omega, *G, error * G[0], error * G[1], source=f"{k}.csv", sd_before=True))
    whole = joined(own)
    assert np.allclose(whole.deviations[0], whole.storage_sd, rtol=0.01)
    assert whole.sd_before and not whole.sd_estimated and whole.source == "0.csv and 1 more file"


@pytest.mark.parametrize(("samples", "load", "power"), [(1, "E", 2), (3, "E", 2), (1, "bending", 4), (3, "bending", 4)])
def test_moduli_of_tension_have_the_size_error_of_a_force(tmp_path, samples, load, power):
    """They had the error of torque over twist, with the fourth power of the radius. Then moduli of bending had the error
    of a force, but the stiffness of a bent rod contains the fourth power."""
    omega, files = np.geomspace(0.1, 100, 20), []
    for k in range(samples):
        E = 3000 * (1 + 0.02 * k) * (0.5 + 0.5j * omega / (1 + 1j * omega))
        E = E * (1 + 0.01 * np.random.default_rng(k).standard_normal(20))
        files.append(str(tmp_path / f"{k}.csv"))
        bent = load == "bending"
        names = ("Flexural storage modulus", "Flexural loss modulus") if bent else ("E'", "E''")
        head = "angular_frequency_rad_s," + ",".join(f"{name} [Pa]" for name in names)
        np.savetxt(files[-1], np.column_stack([omega, E.real, E.imag]), delimiter=",", header=head, comments="")
    ask = ["--method", "closed-form", "--modes", "1", "--radius", "0.001", "--height", "0.02"]
    assert main([*files, *ask, "--out", str(tmp_path / "out")]) == 0
    content = json.loads((tmp_path / "out" / "fit.json").read_text())
    for own in content.get("samples", [content]):
        assert own["details"]["geometry_error"] == pytest.approx(np.hypot(50e-6 / 0.02, power * 10e-6 / 0.001))
