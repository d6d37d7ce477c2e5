"""Fits of every law to brain and to rubber: which laws describe tension, compression and shear at once?

``python -m experiments curves_fit`` writes results/curves_brain.json, .png and curves_rubber.json, .png. Liver is not
in these data, because the chapter's liver curves are published only as pictures.
"""

from experiments.common import ROOT, either, save
from fitting.fits import stress_stretch
from fitting.fits.families import hyperelastic
from fitting.readers import curves
from fitting.reports import curves_report
from fitting.reports.sweep_report import numbers

DATA = ROOT / "data"
LAWS = either(("all",), ("neo_hookean", "veronda_westmann"))


def main() -> None:
    """Fit every law to both materials."""
    for name, file in (("brain", "brain_cortex_curves.csv"), ("rubber", "rubber_curves.csv")):
        found, _ = curves.read_curves([DATA / file])
        candidates = [candidate for law in LAWS for candidate in hyperelastic.candidates(law)]
        fits = curves_report.best_first([stress_stretch.fit(candidate, found) for candidate in candidates])
        print(f"{name}\n{curves_report.table(fits)}")
        content = {"laws": [curves_report.summary(f) for f in fits]}
        save(f"curves_{name}", numbers(content), curves_report.figure(found, fits))


if __name__ == "__main__":
    main()
