"""What the front page prints is what the code does."""

import re
import subprocess
import sys

from conftest import ROOT

PAGE = (ROOT / "README.md").read_text()


def test_numbers_come_from_the_experiments():
    sys.path.insert(0, str(ROOT / "experiments"))
    import readme_numbers

    quoted = PAGE.split(readme_numbers.BEGIN)[1].split(readme_numbers.END)[0].strip()
    assert quoted == readme_numbers.text().strip()


def test_python_example_runs_as_printed():
    (example,) = re.findall(r"```python\n(.*?)```", PAGE, flags=re.DOTALL)
    run = subprocess.run([sys.executable, "-c", example], cwd=ROOT, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    assert len(re.findall(r"\d+\.\d+", run.stdout)) >= 9


def test_pictures_are_there():
    for path in re.findall(r"!\[.*?\]\((.*?)\)", PAGE):
        assert (ROOT / path).is_file()
