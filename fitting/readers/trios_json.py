"""TA TRIOS exports in JSON, converted to the text tables that the other readers read.

Layout: TRIOSJSONExportSchema of TA Instruments. `Results` (or its part `Processed`, or else `Raw`) has three entries:
`ColumnHeaders` gives name and unit for each key, `Rows` have a value for each key, and `ResultsSteps` give the steps of
the test by their id.
"""

import json

#: Key in a row whose value is the id of the row's step.
STEP = "Results Step Id"


def tables(text: str) -> str | None:
    """Tab-separated tables, one per step, with a row of names and a row of units; None if the text is not such JSON."""
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
    """Whether all values are numbers or empty, with at least one number. A value is empty if its point was aborted."""
    return all(v is None or _is_number(v) for v in values) and any(map(_is_number, values))


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _cell(text: object) -> str:
    return " ".join(str(text).split())
