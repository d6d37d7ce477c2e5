"""Read meshes in Abaqus input files (.inp): nodes, elements and their sets.

A file consists of cards. A card is a keyword line such as ``*ELSET, ELSET=hard``, with data lines. Several cards of the
same set add members to the set, and a data line may name another set. The reader of meshio 5.3 keeps only the last card
of a set and ignores the names of sets in data lines. It can also give the set of an ``*ELEMENT`` card to the elements
of another card.
"""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from liverjax.core.errors import InputError

if TYPE_CHECKING:
    import meshio

#: Pattern of Abaqus' element types, with the number of nodes -> meshio's names of the cells. Elements of other types
#: (lines, quadrilaterals, …) are ignored.
_CELLS = {
    r"[AD]?C3D(\d+)[A-Z]*": {
        4: "tetra", 5: "pyramid", 6: "wedge", 8: "hexahedron", 10: "tetra10", 15: "wedge15", 20: "hexahedron20",
    },
    r"(?:S|DS|STRI|M3D|SFM3D|R3D|CPS|CPE)(3|6)5?[A-Z]*": {3: "triangle", 6: "triangle6"},
}  # fmt: skip
#: Keywords that create nodes or elements, or that change coordinates.
_MAKING = ("NGEN", "NFILL", "NCOPY", "NMAP", "ELGEN", "ELCOPY", "SYSTEM")


class _Card(NamedTuple):
    keyword: str  # in capital letters
    parameters: dict[str, str]  # names in capital letters
    lines: list[list[str]]  # cells of the data lines
    inside: bool = True  # whether the card belongs to the part, or to a file without parts; otherwise to the assembly


class _Block(NamedTuple):
    """Elements of one ``*ELEMENT`` card."""

    kind: str  # meshio's name of the cells
    labels: list[int]  # (E,) numbers of the elements in the file
    nodes: np.ndarray  # (E, n) indices of their nodes


def read_abaqus(path: Path) -> "meshio.Mesh":
    """Read an Abaqus input file with one part. The mesh and its sets have the form in which `meshio.read` returns them.

    A set of the part has the name PART.SET if the assembly has a set with the same name. Nodes of the assembly are
    reference points, which are ignored.

    Raises:
        InputError: the file cannot be read, has several parts, or creates nodes or elements by keywords such as *NGEN.
    """
    import meshio

    try:
        cards = _of_one_part(list(_cards(path, ())))
        points, nodes = _read_nodes(cards)
        blocks = {k: _read_block(card, nodes) for k, card in enumerate(cards) if _kind_of_cells(card) is not None}
        elements = [label for block in blocks.values() for label in block.labels]
        _check_unique(elements, "elements")
        by_card = {k: [int(line[0]) for line in card.lines] for k, card in _cards_of(cards, "NODE")}
        node_sets = _sets(cards, "NSET", by_card)
        element_sets = _sets(cards, "ELSET", {k: block.labels for k, block in blocks.items()})
    except _Wrong as error:
        raise InputError(f"mesh file {path}: {error}") from None
    return meshio.Mesh(
        points,
        [(block.kind, block.nodes) for block in blocks.values()],
        point_sets={name: _indices_of(list(nodes), own) for name, own in node_sets.items()},
        cell_sets={
            name: [_indices_of(block.labels, own) for block in blocks.values()] for name, own in element_sets.items()
        },
    )


class _Wrong(Exception):
    """The file cannot be used. The message contains the reason and a remedy."""


def _cards(path: Path, outer: tuple[Path, ...]) -> Iterator[_Card]:
    """Yield the cards of a file and of the files that it includes. `outer`: files that include this file."""
    if path in outer:
        raise _Wrong(f"{path.name} includes itself; remove this *INCLUDE")
    try:
        text = path.read_bytes().decode("utf-8-sig", errors="replace")
    except OSError as error:
        raise _Wrong(f"{path.name} cannot be read ({error.strerror}); give this file") from None
    outer = (*outer, path)
    card, begun = None, ""
    for line in text.splitlines():
        if line.startswith("**") or not line.strip():
            continue
        if begun or line.startswith("*"):
            begun += line.strip()
            if not begun.endswith(","):  # otherwise the keyword line continues on the next line
                yield from () if card is None else _with_included(card, outer)
                card, begun = _card(begun), ""
        elif card is not None:
            card.lines.append([cell.strip(' \t"') for cell in line.split(",")])
    yield from () if card is None else _with_included(card, outer)


def _card(line: str) -> _Card:
    keyword, *others = (cell.strip() for cell in line[1:].split(","))
    pairs = [cell.partition("=") for cell in others]
    return _Card(keyword.upper(), {key.strip().upper(): value.strip(' \t"') for key, _, value in pairs}, [])


def _with_included(card: _Card, outer: tuple[Path, ...]) -> Iterator[_Card]:
    """Yield the card, or the cards of the file that it includes."""
    if card.keyword == "INCLUDE":
        yield from _cards(outer[-1].parent / card.parameters.get("INPUT", ""), outer)
        return
    moved = card.keyword == "INSTANCE" and any(re.search("[1-9]", cell) for line in card.lines for cell in line)
    moved |= card.keyword == "NODE" and card.parameters.get("SYSTEM", "R").upper() != "R"  # not Cartesian coordinates
    if moved or card.keyword in _MAKING:
        raise _Wrong(
            f"*{card.keyword} changes or makes the mesh; export the finished mesh, with all nodes and elements"
        )
    yield card


def _of_one_part(cards: list[_Card]) -> list[_Card]:
    """Mark the cards outside the part, and remove the nodes and elements outside the part."""
    parts = _cards_of(cards, "PART")
    if not parts:
        return cards
    if len(parts) > 1 or len(_cards_of(cards, "INSTANCE")) > 1:
        raise _Wrong("the file has several parts or instances; export one part with one mesh")
    begin, end = parts[0][0], next((k for k, _ in _cards_of(cards, "END PART")), len(cards))
    marked = [card._replace(inside=begin < k < end) for k, card in enumerate(cards)]
    return [card for card in marked if card.inside or card.keyword not in ("NODE", "ELEMENT")]


def _cards_of(cards: list[_Card], keyword: str) -> list[tuple[int, _Card]]:
    return [(k, card) for k, card in enumerate(cards) if card.keyword == keyword]


def _read_nodes(cards: list[_Card]) -> tuple[np.ndarray, dict[int, int]]:
    """Return the coordinates (V, 3), and {number of a node in the file: its index}."""
    lines = [line for _, card in _cards_of(cards, "NODE") for line in card.lines]
    try:
        labels = [int(line[0]) for line in lines]
        # Fortran writes the exponent as D.
        points = [[float(cell.upper().replace("D", "E") or 0) for cell in [*line[1:4], "", ""][:3]] for line in lines]
    except ValueError as error:
        raise _Wrong(f"*NODE contains a wrong number ({error}); export the mesh again") from None
    _check_unique(labels, "nodes")
    return np.array(points).reshape(-1, 3), {label: k for k, label in enumerate(labels)}


def _check_unique(labels: list[int], what: str) -> None:
    if len(set(labels)) < len(labels):
        raise _Wrong(f"two {what} have the same number; export one part with one mesh")


def _kind_of_cells(card: _Card) -> tuple[str, int] | None:
    """Return meshio's name of the cells of an ``*ELEMENT`` card, and their number of nodes.

    Returns None for other cards and for ignored types of elements.
    """
    if card.keyword == "ELEMENT":
        kind = card.parameters.get("TYPE", "").upper()
        for pattern, names in _CELLS.items():
            match = re.fullmatch(pattern, kind)
            if match:
                return names.get(int(match[1]), kind), int(match[1])
    return None


def _read_block(card: _Card, nodes: dict[int, int]) -> _Block:
    """Return the elements of an ``*ELEMENT`` card. An element may continue on the next line."""
    kind, size = _kind_of_cells(card) or ("", 0)
    try:
        numbers = np.array([int(cell) for line in card.lines for cell in line if cell], int)
        rows = numbers.reshape(-1, 1 + size)
        places = [nodes[label] for label in rows[:, 1:].ravel().tolist()]
    except ValueError:
        raise _Wrong(f"lines of *ELEMENT, TYPE={card.parameters['TYPE']} are not complete; export the mesh") from None
    except KeyError as error:
        raise _Wrong(f"*ELEMENT contains node {error.args[0]}, but *NODE does not; export the mesh again") from None
    return _Block(kind, rows[:, 0].tolist(), np.array(places, int).reshape(-1, size))


def _sets(cards: list[_Card], key: str, by_card: dict[int, list[int]]) -> dict[str, set[int]]:
    """Return the numbers of the members of all sets. Abaqus does not distinguish capital letters in names of sets.

    Args:
        cards: cards of the file.
        key: "NSET" or "ELSET".
        by_card: {index of a card: numbers of the nodes or elements that this card defines}.
    """
    names: dict[str, str] = {}  # names in small letters -> names as the file first writes them
    scopes: dict[bool, dict[str, set[int]]] = {True: {}, False: {}}  # sets of the part, and sets of the assembly
    for k, card in enumerate(cards):
        if key in card.parameters and (k in by_card or card.keyword == key):
            name, sets = card.parameters[key].lower(), scopes[card.inside]
            names.setdefault(name, card.parameters[key])
            known = scopes[True] | sets  # data lines may name sets of the part and of the assembly
            sets.setdefault(name, set()).update(by_card[k] if k in by_card else _members(card, known))
    part = next((card.parameters.get("NAME", "part") for _, card in _cards_of(cards, "PART")), "")
    own = {f"{part}.{names[name]}" if name in scopes[False] else names[name]: m for name, m in scopes[True].items()}
    return own | {names[name]: members for name, members in scopes[False].items()}


def _members(card: _Card, sets: dict[str, set[int]]) -> set[int]:
    """Return the numbers in a card of a set. A data line contains numbers and names of earlier sets, or with GENERATE
    the first and last number and the step."""
    found: set[int] = set()
    if len(card.parameters.keys() & {"NSET", "ELSET"}) > 1:
        raise _Wrong(f"*{card.keyword} selects the nodes of an element set, which is not implemented; list the nodes")
    if not card.inside and "INSTANCE" not in card.parameters:  # numbers without a name are those of reference points
        card = card._replace(lines=[[cell for cell in line if not cell.isdigit()] for line in card.lines])
    for line in card.lines:
        cells = [cell for cell in line if cell]
        if "GENERATE" in card.parameters and cells:
            found |= _range_of(card, cells)
            continue
        for cell in cells:
            number = cell.rpartition(".")[2]  # a number or a name may follow the name of its part
            name = number.lower() if cell.lower() not in sets else cell.lower()
            if not number.isdigit() and name not in sets:
                raise _Wrong(f"*{card.keyword} contains {cell}, which is no earlier set; define this set before")
            found |= {int(number)} if number.isdigit() else sets[name]
    return found


def _range_of(card: _Card, cells: list[str]) -> set[int]:
    """Return the numbers of a data line with the first and last number and the step (default 1)."""
    if not 2 <= len(cells) <= 3 or not all(cell.isdigit() for cell in cells) or cells[2:] == ["0"]:
        raise _Wrong(f"*{card.keyword}, GENERATE has the line {','.join(cells)}; give first, last, step")
    first, last, step = (int(cell) for cell in (*cells, "1")[:3])
    return set(range(first, last + 1, step))


def _indices_of(labels: list[int], members: set[int]) -> np.ndarray:
    """Return the indices of the members among the labels. Numbers that are no label are ignored."""
    return np.array([k for k, label in enumerate(labels) if label in members], int)
