"""What the front page prints is what the code does."""

import re
import subprocess
import sys

from conftest import ROOT

PAGE = (ROOT / "README.md").read_text()


def test_numbers_come_from_the_experiments():
    sys.path.insert(0, str(ROOT / "experiments"))
    import readme_numbers

    for part, text in readme_numbers.PARTS.items():
        quoted = PAGE.split(readme_numbers.begin(part))[1].split(readme_numbers.END)[0].strip()
        assert quoted == text().strip()


def test_python_example_runs_as_printed():
    example, _ = re.findall(r"```python\n(.*?)```", PAGE, flags=re.DOTALL)
    run = subprocess.run([sys.executable, "-c", example], cwd=ROOT, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    assert len(re.findall(r"\d+\.\d+", run.stdout)) >= 9


def test_law_of_ten_lines_passes_the_check_as_printed(tmp_path, capsys):
    from liverjax.__main__ import main

    _, law = re.findall(r"```python\n(.*?)```", PAGE, flags=re.DOTALL)
    body = law.split("@lj.struct")[1].strip().splitlines()
    assert len([line for line in body if line.strip()]) <= 10
    (tmp_path / "my_law.py").write_text(law)
    assert main(["check", f"{tmp_path / 'my_law.py'}:Gent", "--out", str(tmp_path)]) == 0
    assert main(["check", f"{ROOT / 'experiments' / 'my_law.py'}:Gent", "--out", str(tmp_path)]) == 0
    assert "FAILED" not in capsys.readouterr().out


def test_pictures_are_there():
    for path in re.findall(r"!\[.*?\]\((.*?)\)", PAGE):
        assert (ROOT / path).is_file()
