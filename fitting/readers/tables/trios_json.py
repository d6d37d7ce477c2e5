"""TA TRIOS exports in JSON, converted to the text tables that the other readers read.

The layout is the TRIOSJSONExportSchema of TA Instruments. The table is in `Results`, or in its entry `Processed` or
`Raw`. There, `ColumnHeaders` gives the name and unit of each column key, and `Rows` gives a value for each key.
`ResultsSteps` gives the name of each test step by its id.
"""

import json

#: Key in each row for the id of its test step.
STEP = "Results Step Id"


def tables(text: str) -> str | None:
    """Return tab-separated tables, one for each step, with a row of names and a row of units. Returns None if the
    string is not JSON of this layout."""
    try:
        content = json.loads(text)
        results = content["Results"]
        results = next((results[part] for part in ("Processed", "Raw") if part in results), results)
        headers, rows = results["ColumnHeaders"], results["Rows"]
        steps = {step["Id"]: str(step.get("Name", "")) for step in results.get("ResultsSteps", [])}
        lines = []
        for step in dict.fromkeys(row.get(STEP) for row in rows):
            own = [row for row in rows if row.get(STEP) == step]
            keys = [k for k in headers if _is_column([row.get(k) for row in own])]
            lines += ["[step]", steps.get(step, "") or "step"]
            lines.append("\t".join(_cell(headers[k].get("DisplayName", k)) for k in keys))
            lines.append("\t".join(_cell((headers[k].get("Unit") or {}).get("Name", "")) for k in keys))
            lines += ["\t".join("" if row.get(k) is None else repr(float(row[k])) for k in keys) for row in own]
            lines.append("")
    except (ValueError, KeyError, TypeError, AttributeError):
        return None
    return "\n".join(lines) if lines else None


def _is_column(values: list) -> bool:
    """Return whether all values are numbers or empty, with at least one number. Aborted points have empty values."""
    return all(v is None or _is_number(v) for v in values) and any(map(_is_number, values))


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _cell(text: object) -> str:
    return " ".join(str(text).split())
