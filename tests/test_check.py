"""The gradient check: every shipped law passes, planted mistakes fail in the right row, files are read."""

import textwrap
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import liverjax as lj
from liverjax.__main__ import main
from liverjax.laws import figures, gradient_check, homogeneous, stability_check

pytestmark = pytest.mark.quick_to_compile

HEAD = """
import jax.numpy as jnp
import liverjax as lj
from liverjax.laws import NeoHookean


@lj.struct
class Law(NeoHookean):
    '''W = mu/2 (Ibar1 - 3) + U(J), with a mistake.'''
"""

#: Text that is added to a neo-Hookean law -> the row that must fail.
MISTAKES = {
    "wrong sign": (
        """
        def isochoric_derivatives(self, I1, I2):
            return {"I1": -self.mu / 2}, {}
        """,
        "stress by hand",
    ),
    "factor 2": (
        """
        def isochoric_derivatives(self, I1, I2):
            return {"I1": self.mu}, {}
        """,
        "energy to stress",
    ),
    "wrong curvature": (
        """
        def isochoric_derivatives(self, I1, I2):
            return {"I1": self.mu / 2}, {("I1", "I1"): 0.1 * self.mu}
        """,
        "stress to tangent",
    ),
    "wrong beyond moderate stretches": (
        """
        def isochoric_derivatives(self, I1, I2):
            return {"I1": self.mu / 2 + jnp.where(I1 > 4.2, 0.1 * self.mu, 0.0)}, {}
        """,
        "stress by hand against autodiff, stretches 0.5 to 2",
    ),
    "wrong where a number is not 0": (
        """
        more: float = lj.param("Pa", typical=0.0)

        def isochoric_energy(self, I1, I2):
            return self.mu / 2 * (I1 - 3) + self.more * (I1 - 3) ** 2

        def isochoric_derivatives(self, I1, I2):
            return {"I1": self.mu / 2 + self.more * (I1 - 3)}, {("I1", "I1"): self.more}
        """,
        "stress by hand against autodiff, parameters times 0.8",
    ),
    "another energy than its parts": (
        """
        def strain_energy(self, I):
            W = self.mu * (I.J ** (-2 / 3) * I.I1 - 3)
            return W if self.bulk is None else W + self.bulk / 4 * (I.J - 1) ** 2
        """,
        "energy is that of its parts",
    ),
    "a jump": (
        """
        isochoric_derivatives = None

        def isochoric_energy(self, I1, I2):
            return self.mu / 2 * (I1 - 3) * jnp.where(I1 > 3.2, 2.0, 1.0)
        """,
        "the energy jumps",
    ),
    "a jump of the stress": (
        """
        isochoric_derivatives = None

        def isochoric_energy(self, I1, I2):
            return self.mu / 2 * (I1 - 3 + jnp.maximum(I1 - 3.2, 0.0))
        """,
        "the stress jumps",
    ),
    "a jump with the volume": (
        """
        def strain_energy(self, I):
            W = self.mu / 2 * (I.J ** (-2 / 3) * I.I1 - 3)
            return W if self.bulk is None else W + self.bulk / 2 * (I.J - 1) ** 2 * jnp.where(I.J > 1.5, 2.0, 1.0)

        def volumetric_part(self):
            return None
        """,
        "the energy jumps",
    ),
    "an isochoric part that depends on the volume": (
        """
        def strain_energy(self, I):
            W = self.mu / 2 * (I.I1 - 3 - 2 * jnp.log(I.J))
            return W if self.bulk is None else W + self.bulk / 2 * (I.J - 1) ** 2
        """,
        "the isochoric part depends on the volume",
    ),
    "not objective": (
        """
        def energy(self, F):
            return super(Law, self).energy(F) + self.mu * F[..., 0, 1] ** 2
        """,
        "objective: W",
    ),
    "NaN at rest": (
        """
        isochoric_derivatives = None  # by automatic differentiation again

        def isochoric_energy(self, I1, I2):
            return self.mu * jnp.sqrt(I1 - 3) ** 2
        """,
        "tangent at rest",
    ),
    "energy at rest": (
        """
        def isochoric_energy(self, I1, I2):
            return self.mu / 2 * (I1 - 2)
        """,
        "energy at rest",
    ),
    "wrong modulus stated": (
        """
        def shear_modulus(self):
            return 2 * self.mu
        """,
        "ground-state shear modulus",
    ),
    "negative bulk modulus": (
        """
        isochoric_energy = isochoric_derivatives = None

        def strain_energy(self, m):
            return self.mu / 2 * (m.I1 - 3) - self.mu * jnp.log(m.J) - 0.45 * self.mu * jnp.log(m.J) ** 2
        """,
        "stiffness at rest",
    ),
    "unstable at rest": (
        """
        def isochoric_energy(self, I1, I2):
            return -self.mu / 2 * (I1 - 3)

        def isochoric_derivatives(self, I1, I2):
            return {"I1": -self.mu / 2}, {}
        """,
        "stable in uniaxial",
    ),
}


#: A wrong derivative, a wrong value, and a state without derivatives. The other mistakes run with -m slow.
FIRST = ("wrong sign", "NaN at rest")


@pytest.mark.ci
@pytest.mark.parametrize("mistake", [m if m in FIRST else pytest.param(m, marks=pytest.mark.slow) for m in MISTAKES])
def test_planted_mistakes_are_caught(mistake, tmp_path, capsys, monkeypatch):
    body, row = MISTAKES[mistake]
    if mistake != "NaN at rest":  # one picture of a wrong law is enough; this one has the fewest numbers
        monkeypatch.setattr(figures, "gradient_check", lambda *_: None)
    file = tmp_path / "mine.py"
    file.write_text(HEAD + textwrap.indent(textwrap.dedent(body), "    "))
    assert main(["check", f"{file}:Law", "--out", str(tmp_path)]) == 1
    output = capsys.readouterr()
    assert f"failed: {row}" in output.err
    assert "FAILED" in output.out


@pytest.mark.ci
@pytest.mark.parametrize(
    "steep",
    [
        "jnp.maximum(1 - (I1 - 3) / 0.5, 1e-6)",
        pytest.param("jnp.maximum(1 - (I1 - 3) / 9.0, 1e-3)", marks=pytest.mark.slow),
    ],
)
def test_a_steep_energy_is_no_jump(steep, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(figures, "gradient_check", lambda *_: None)
    file = tmp_path / "mine.py"
    file.write_text(
        HEAD
        + f"""
    isochoric_derivatives = None

    def isochoric_energy(self, I1, I2):
        return -self.mu * 0.25 * jnp.log({steep})
"""
    )
    main(["check", f"{file}:Law", "--out", str(tmp_path)])
    output = capsys.readouterr()
    assert "stable in uniaxial" in output.out and "the energy jumps" not in output.out


def test_a_law_of_the_volume_alone_does_not_jump():
    """In tests with constant volume the energy of this law is 0, up to rounding of 1e-28 Pa. This was reported as a
    jump.
    """

    @lj.struct
    class Volume(lj.Law):
        k: float = lj.param("Pa", typical=2000.0)
        invariants = ("J",)

        def strain_energy(self, I):
            return self.k / 4 * (I.J**2 - 1 - 2 * jnp.log(I.J))

    law = Volume(k=2000.0)
    assert stability_check.jump_rows(jax.jit(law.energy), jax.jit(law.first_piola), jax.jit(law.tangent)) == []


def test_an_isochoric_law_does_not_jump():
    """At pure volume changes the energy of this law is 0, up to rounding of 1e-13 Pa. This was reported as a jump."""
    law = lj.laws.NeoHookean(mu=770.0, bulk=None)
    assert stability_check.jump_rows(jax.jit(law.energy), jax.jit(law.first_piola), jax.jit(law.tangent)) == []


def test_a_number_that_is_forgotten_in_the_energy_is_named(tmp_path, capsys):
    file = tmp_path / "mine.py"
    file.write_text(
        HEAD
        + """
    more: float = lj.param("Pa", typical=3.0)
"""
    )
    assert main(["check", f"{file}:Law", "--out", str(tmp_path)]) == 1  # a misspelt energy did not change the exit code
    (row,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("parameters without effect")]
    assert row.split()[3:5] == ["FAILED", "more"]


@pytest.mark.ci
@pytest.mark.parametrize(
    "stated, agrees",
    [
        pytest.param("self.mu", True, marks=pytest.mark.slow),
        ("self.mu + 4 * self.k / 15", True),
        pytest.param("2 * self.mu", False, marks=pytest.mark.slow),
    ],
)
def test_fibres_that_go_slack_have_a_stiffness_for_each_side(stated, agrees, tmp_path, monkeypatch):
    """For W = k/2 max(I4 - 1, 0)^2, stretched fibres add 4 k along their direction. At rest, JAX gives a
    quarter of it.
    """
    monkeypatch.setattr(figures, "gradient_check", lambda *_: None)
    file = tmp_path / "mine.py"
    file.write_text(
        "import jax.numpy as jnp\nimport liverjax as lj\n\n@lj.struct\nclass Fibres(lj.Law):\n"
        '    mu: float = lj.param("Pa", typical=700.0)\n    k: float = lj.param("Pa", typical=500.0)\n'
        '    bulk: float = lj.param("Pa", typical=5000.0)\n'
        '    fibre: tuple = lj.param("1", each=True, typical=(1.0, 0.0, 0.0))\n'
        '    volumetric: str = lj.static("quadratic")\n'
        '    invariants = ("I1", "I4", "J")\n'
        f"    def shear_modulus(self):\n        return {stated}\n"
        "    def strain_energy(self, I):\n        slack = jnp.maximum(I.I4 - 1, 0.0)\n"
        "        own = self.mu / 2 * (I.I1 * I.J ** (-2 / 3) - 3) + self.bulk / 2 * (I.J - 1) ** 2\n"
        "        return own + self.k / 2 * slack**2\n"
    )
    rows = {row.name: row for row in gradient_check.check(gradient_check.load(f"{file}:Fibres")).rows}
    assert rows["ground-state shear modulus"].passed is agrees
    low, high = (float(v) for v in rows["ground-state shear modulus"].found.removesuffix(" Pa").split(" to "))
    assert low == pytest.approx(700, rel=1e-4) and high == pytest.approx(700 + 4 * 500 / 15, rel=1e-4)
    assert "stiffness at rest jumps" in rows


_UNUSABLE = {
    # The isochoric part of a law is made without its bulk modulus.
    "isochoric_part cannot be evaluated": """
    def strain_energy(self, I):
        return self.mu / 2 * (I.J ** (-2 / 3) * I.I1 - 3) + self.bulk / 2 * (I.J - 1) ** 2
""",
    # In a run, the parameters of a law are traced.
    "write conditions on parameters with jnp.where": """
    def isochoric_energy(self, I1, I2):
        return self.mu / 2 * (I1 - 3) if self.mu > 1 else 0 * I1
""",
}


@pytest.mark.parametrize("words", _UNUSABLE)
def test_a_law_that_no_scene_can_use_gets_one_sentence(words, tmp_path, capsys):
    file = tmp_path / "mine.py"
    file.write_text(HEAD + _UNUSABLE[words])
    assert main(["check", f"{file}:Law", "--out", str(tmp_path)]) == 2
    assert words in capsys.readouterr().err


@pytest.mark.ci
@pytest.mark.draws
@pytest.mark.parametrize(
    "name", ["saint_venant_kirchhoff", *(pytest.param(n, marks=pytest.mark.slow) for n in ("neo_hookean", "costa"))]
)
def test_shipped_laws_pass(name, tmp_path, capsys):
    assert main(["check", name, "--out", str(tmp_path)]) == 0
    assert (tmp_path / f"check_{name}.png").stat().st_size > 10_000
    assert "FAILED" not in capsys.readouterr().out


USERS_FILE = """
from __future__ import annotations
from typing import ClassVar
import jax.numpy as jnp
import liverjax as lj


@lj.struct
class Whole(lj.Law):
    mu: float = lj.param("Pa", typical=770.0)
    k: float = lj.param("Pa", typical=7000.0)
    invariants: ClassVar = ("I1", "J")

    def strain_energy(self, I):
        return self.mu / 2 * (I.J ** (-2 / 3) * I.I1 - 3) + self.k / 2 * (I.J - 1) ** 2


@lj.struct
class Forgets(lj.Law):
    mu: float = lj.param("Pa", typical=770.0)
    invariants: ClassVar = ("I1",)

    def strain_energy(self, I):
        return self.mu * (I.I2 - 3)


@lj.struct
class Shapeless(lj.Law):
    mu: float = lj.param("Pa", typical=770.0)
    invariants: ClassVar = ("I1",)

    def strain_energy(self, I):
        return self.mu * jnp.sum(I.I1 - 3)
"""


@pytest.mark.core
def test_users_laws_pass_or_are_refused_in_one_sentence(tmp_path, capsys):
    file = tmp_path / "jax.py"  # a name that must not hide the package
    file.write_text(USERS_FILE)
    assert main(["check", f"{file}:Whole", "--out", str(tmp_path)]) == 0
    assert "not stated" in capsys.readouterr().out
    for name, sentence in (("Forgets", "List all invariants"), ("Shapeless", "has shape")):
        assert main(["check", f"{file}:{name}", "--out", str(tmp_path)]) == 2
        error = capsys.readouterr().err
        assert sentence in error and error.count("\n") == 1


def test_differences_have_the_v_shape():
    result = gradient_check.check(lj.laws.typical("yeoh"))
    for errors in result.difference_errors.values():
        k = int(np.argmin(errors))
        assert 1.9 < np.log10(errors[1] / errors[3]) < 2.1  # second order in the range where the error falls
        assert errors[0] > 1e3 * errors[k] < errors[-1]


@pytest.mark.slow
def test_stable_ranges_of_known_laws():
    # Mooney-Rivlin with c01 < 0: P = 2 (l - l^-2)(c10 + c01/l) has a negative derivative below `root`.
    c10, c01 = 400.0, -100.0
    l = np.linspace(0.1, 1.0, 100_001)
    slope = 2 * ((1 + 2 * l**-3) * (c10 + c01 / l) - (l - l**-2) * c01 / l**2)
    root = l[slope < 0].max()
    low, _ = gradient_check.check(lj.laws.MooneyRivlin(c10=c10, c01=c01, bulk=7700.0)).stable["uniaxial"]
    assert 0 <= low - root < 0.1  # ellipticity may be lost slightly before
    assert gradient_check.check(lj.laws.typical("neo_hookean")).stable["uniaxial"] == (0.2, 4.0)


@pytest.mark.parametrize(
    ("argument", "sentence"),
    [
        ("neo_hokean", "did you mean neo_hookean"),
        ("nothing.py:Law", "is not a file"),
        ("mine.py", "mine.py names a file, but not a law in this file: use mine.py:Law"),
        ("mine.py:Lew", "use mine.py:Law"),
        ("mine.py:number", "is not a law"),
        ("mine.py:Bare", "write @liverjax.struct"),
        ("mine.py:NoTypical", "parameter mu has no typical value"),
        ("broken.py:Law", "does not run"),
    ],
)
def test_files_are_refused_in_one_sentence(argument, sentence, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.py").write_text(
        HEAD
        + "    pass\n\nnumber = 3\n\nclass Bare(lj.Law):\n    pass\n\n"
        + "@lj.struct\nclass NoTypical(lj.Law):\n    mu: float = lj.param('Pa')\n"
    )
    (tmp_path / "broken.py").write_text("import no_such_module")
    assert main(["check", argument]) == 2
    error = capsys.readouterr().err
    assert sentence in error and error.count("\n") == 1


@pytest.mark.draws
def test_plot_draws_laws(tmp_path, capsys):
    assert main(["plot", "neo_hookean", "yeoh", "--out", str(tmp_path)]) == 0
    assert (tmp_path / "laws.png").stat().st_size > 10_000
    assert main(["plot", "yeoh", "--stretch", "1.2", "1.6", "--out", str(tmp_path)]) == 2
    assert "not a range that contains 1" in capsys.readouterr().err
    assert main(["plot", "yeoh", "--step", "2", "--out", str(tmp_path)]) == 2
    assert "--step is for results, not for yeoh" in capsys.readouterr().err


def test_laws_lists_every_law(capsys):
    assert main(["laws"]) == 0
    text = capsys.readouterr().out
    assert all(name in text for name in lj.laws.LAWS)
    assert "not 0" in text and "default (1.0, 0.0, 0.0)" in text


def test_homogeneous_stress_against_textbook_formulas():
    stretch = jnp.linspace(0.5, 2.0, 31)
    mooney = lj.laws.MooneyRivlin(c10=300.0, c01=85.0, bulk=7700.0)
    c1, c2 = 300.0, 85.0
    exact = {
        "uniaxial": 2 * (stretch - stretch**-2) * (c1 + c2 / stretch),
        "equibiaxial": 2 * (stretch - stretch**-5) * (c1 + stretch**2 * c2),
        "pure_shear": 2 * (stretch - stretch**-3) * (c1 + c2),
        "simple_shear": 2 * stretch * (c1 + c2),
    }
    for test, expected in exact.items():
        assert np.allclose(homogeneous.response(mooney, test, stretch), expected, rtol=1e-12, atol=1e-10)
    ogden = lj.laws.Ogden(mu=(300.0, -150.0), alpha=(1.7, -2.6), bulk=7700.0)
    expected = sum(m * (stretch ** (a - 1) - stretch ** (-a / 2 - 1)) for m, a in ((300.0, 1.7), (-150.0, -2.6)))
    assert np.allclose(homogeneous.response(ogden, "uniaxial", stretch), expected, rtol=1e-12, atol=1e-10)
    with pytest.raises(lj.InputError, match="use one of uniaxial"):
        homogeneous.deformation_gradient("torsion", stretch)


@lj.struct
class Gent(lj.Law):
    """A law with an infinite energy at a uniaxial stretch of 1.26."""

    mu: float = lj.param("Pa", typical=770.0)
    limit: float = lj.param("1", typical=0.2)
    bulk: float = lj.param("Pa", typical=7700.0)
    volumetric: str = lj.static("quadratic")

    def isochoric_energy(self, I1, I2):
        """Return -mu limit/2 ln(1 - (Ibar1 - 3)/limit)."""
        return -self.mu * self.limit / 2 * jnp.log1p(-(I1 - 3) / self.limit)


@lj.struct
class Fibres(lj.Law):
    """Slack fibres alone: no stiffness at rest, and never any stiffness perpendicular to the fibres."""

    k: float = lj.param("Pa", typical=100.0)
    fibre: tuple = lj.static((1.0, 0.0, 0.0))
    invariants: ClassVar = ("I4",)

    def strain_energy(self, I):
        """Return k/4 (I4 - 1)^4."""
        return self.k / 4 * (I.I4 - 1) ** 4


@pytest.mark.parametrize(
    "law, told",
    [
        (Gent(mu=770.0, limit=0.2, bulk=7700.0), ("only from 0.85 to 1.18", "stretch 0.78 to 1.26")),
        (Fibres(k=100.0), ("no stiffness at rest", "0.0e+00 Pa")),
        pytest.param(lj.laws.NeoHookean(mu=-770.0, bulk=7700.0), ("not even at rest",), marks=pytest.mark.slow),
    ],
)
def test_laws_that_lock_and_parts_of_laws_are_no_mistakes(law, told):
    result = gradient_check.check(law)
    text = gradient_check.table(result)
    assert all(words in text for words in told)
    unstable = [row.name for row in result.failed]
    assert all(name.startswith(("stable in", "stiffness at rest")) for name in unstable)
    assert bool(unstable) == ("not even at rest" in told)
