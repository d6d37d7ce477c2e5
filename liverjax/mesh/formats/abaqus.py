"""Read meshes in Abaqus input files (.inp): nodes, elements, their sets, and surfaces of tetrahedra.

A file consists of cards. A card is a keyword line such as ``*ELSET, ELSET=hard``, with data lines. Several cards of the
same set add members to the set, and a data line may name another set. The reader of meshio 5.3 keeps only the last card
of a set and ignores the names of sets in data lines. That reader can also give the set of an ``*ELEMENT`` card to the
elements of another card.
"""

import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from liverjax.core.errors import InputError

if TYPE_CHECKING:
    import meshio

#: Pattern of Abaqus' element types -> {number of nodes: meshio's name of the cells}. The number in parentheses in the
#: pattern is the number of nodes. Elements of other types (lines, quadrilaterals, …) are ignored.
_CELLS = {
    r"(?:[AD]?C3D|SC|COH3D)(\d+)[A-Z]*": {
        4: "tetra", 5: "pyramid", 6: "wedge", 8: "hexahedron", 10: "tetra10", 15: "wedge15", 20: "hexahedron20",
        27: "hexahedron27",
    },
    r"(?:S|DS|STRI|M3D|SFM3D|R3D|CPS|CPE)(3|6)5?[A-Z]*": {3: "triangle", 6: "triangle6"},
}  # fmt: skip
#: Corners of the faces S1 … S4 of a tetrahedron, counterclockwise if seen from outside.
_FACES = {"S1": (0, 2, 1), "S2": (0, 1, 3), "S3": (1, 2, 3), "S4": (0, 3, 2)}
#: Keywords that create nodes or elements, or that change coordinates.
_MAKING = ("NGEN", "NFILL", "NCOPY", "NMAP", "ELGEN", "ELCOPY", "SYSTEM")


#: Place (key) of a set or surface: (True in the part, False in the assembly; its name in small letters).
_Place = tuple[bool, str]


class _Card(NamedTuple):
    keyword: str  # in capital letters
    parameters: dict[str, str]  # names in capital letters
    lines: list[list[str]]  # cells of the data lines
    inside: bool = True  # True: the card is in the part, or the file has no parts. False: it is in the assembly.
    assembly: str = ""  # name of the assembly in small letters; "" if missing, or also the name of the part or instance


class _Block(NamedTuple):
    """Elements of one ``*ELEMENT`` card."""

    kind: str  # meshio's name of the cells
    labels: list[int]  # (E,) numbers of the elements in the file
    nodes: np.ndarray  # (E, n) indices of their nodes


def read_abaqus(path: Path) -> "meshio.Mesh":
    """Read an Abaqus input file with one part. The result has the same form as the result of `meshio.read`.

    If the part and the assembly both have a set or surface named SET, the set or surface of the part is named PART.SET.
    Nodes of the assembly are reference points, which are ignored.

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
        element_members = _members(cards, "ELSET", {k: block.labels for k, block in blocks.items()}, {})
        element_sets = _sets_by_name(cards, "ELSET", element_members)
        by_card = {k: [int(line[0]) for line in card.lines] for k, card in _cards_of(cards, "NODE")}
        of_elements = _nodes_of(element_members, blocks, list(nodes))
        node_sets = _sets_by_name(cards, "NSET", _members(cards, "NSET", by_card, of_elements))
        surfaces = _surfaces(cards, element_members, blocks)
    except _Wrong as error:
        raise InputError(f"mesh file {path}: {error}") from None
    none = [np.zeros(0, int)] * len(surfaces)
    cell_sets = {
        name: [*(_indices_of(block.labels, own) for block in blocks.values()), *none]
        for name, own in element_sets.items()
    }
    for k, (name, triangles) in enumerate(surfaces.items()):
        own = cell_sets.setdefault(name, [np.zeros(0, int)] * (len(blocks) + len(surfaces)))
        own[len(blocks) + k] = np.arange(len(triangles))  # a set of elements with the same name keeps its elements
    return meshio.Mesh(
        points,
        [*((block.kind, block.nodes) for block in blocks.values()), *(("triangle", own) for own in surfaces.values())],
        point_sets={name: _indices_of(list(nodes), own) for name, own in node_sets.items()},
        cell_sets=cell_sets,
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
        if begun and _is_data(line):
            begun = begun.rstrip(",")  # a data line follows, so the comma at the end of the keyword line is not needed
            yield from () if card is None else _with_included(card, outer)
            card, begun = _card(begun), ""
        if begun or line.startswith("*"):
            begun += line.strip()
            if not begun.endswith(","):  # otherwise the keyword line continues on the next line
                yield from () if card is None else _with_included(card, outer)
                card, begun = _card(begun), ""
        elif card is not None:
            card.lines.append([cell.strip(' \t"') for cell in line.split(",")])
    yield from () if card is None else _with_included(card, outer)


def _is_data(line: str) -> bool:
    """Return whether a line is a data line, although the keyword line before it ends with a comma. A data line begins
    with a whole number, or has no letters."""
    return re.match(r"\s*\d+\s*,", line) is not None or not re.search("^[*]|=|[A-Za-z]", line)


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
            f"*{card.keyword} moves or creates nodes or elements; export the finished mesh, with all nodes and elements"
        )
    yield card


def _of_one_part(cards: list[_Card]) -> list[_Card]:
    """Mark the cards outside the part, and remove the nodes and elements outside the part."""
    parts = _cards_of(cards, "PART")
    if not parts:
        return cards
    if len(parts) > 1 or len(_cards_of(cards, "INSTANCE")) > 1:
        raise _Wrong("the file has several parts or instances; export one part with one mesh")
    names = {card.keyword: card.parameters.get("NAME", "").lower() for card in cards}
    assembly = names.get("ASSEMBLY", "")
    assembly = "" if assembly in (names["PART"], names.get("INSTANCE")) else assembly
    inside, depth = [], 0  # if the part is empty, its instance may contain the nodes and elements
    for card in cards:
        depth -= card.keyword in ("END PART", "END INSTANCE")
        inside.append(depth > 0)
        depth += card.keyword in ("PART", "INSTANCE")
    marked = [card._replace(inside=own, assembly=assembly) for card, own in zip(cards, inside, strict=True)]
    # NODE and ELEMENT cards outside the part lose their data lines. Their sets still exist, but are empty.
    kept = [card for card in marked if card.inside or card.keyword not in ("NODE", "ELEMENT")]
    return kept + [
        card._replace(lines=[]) for card in marked if not card.inside and card.keyword in ("NODE", "ELEMENT")
    ]


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
            if match and int(match[1]) not in names:
                raise _Wrong(f"the file contains elements of type {kind}; export tetrahedra of 4 or 10 nodes")
            if match:
                return names[int(match[1])], int(match[1])
    return None


def _read_block(card: _Card, nodes: dict[int, int]) -> _Block:
    """Return the elements of an ``*ELEMENT`` card. An element may continue on the next line."""
    kind, size = _kind_of_cells(card) or ("", 0)
    try:
        numbers = np.array([int(cell) for line in card.lines for cell in line if cell], int)
        rows = numbers.reshape(-1, 1 + size)
        places = [nodes[label] for label in rows[:, 1:].ravel().tolist()]
    except ValueError:
        raise _Wrong(
            f"lines of *ELEMENT, TYPE={card.parameters['TYPE']} are not complete; export the mesh again"
        ) from None
    except KeyError as error:
        raise _Wrong(f"*ELEMENT contains node {error.args[0]}, but *NODE does not; export the mesh again") from None
    return _Block(kind, rows[:, 0].tolist(), np.array(places, int).reshape(-1, size))


def _cards_of_sets(cards: list[_Card], key: str) -> dict[_Place, list[int]]:
    """Return {place of a set: indices of its cards}. `key`: "NSET" or "ELSET"."""
    making = {"NSET": "NODE", "ELSET": "ELEMENT"}[key]
    found: dict[_Place, list[int]] = {}
    for k, card in enumerate(cards):
        if key in card.parameters and card.keyword in (key, making):
            found.setdefault((card.inside, card.parameters[key].lower()), []).append(k)
    return found


def _place_of(name: str, card: _Card, places: Iterable[_Place], kind: str) -> _Place:
    """Return the place of the set `name` that a card mentions. `kind`: the kind of the set (set of nodes or of
    elements), for messages."""
    small = name.lower()
    before, _, last = small.rpartition(".")  # the name of the part or assembly may stand before the name of the set
    candidates = [(card.inside, small), (True, small), (True, last), (False, small), (False, last)]
    if before and before == card.assembly:
        candidates.insert(0, (False, last))
    at = next((place for place in candidates if place in places), None)
    if at is None:
        raise _Wrong(f"*{card.keyword} contains {name}, but the file does not define this {kind}; define it")
    return at


def _members(
    cards: list[_Card], key: str, by_card: dict[int, list[int]], of_elements: dict[_Place, set[int]]
) -> dict[_Place, set[int]]:
    """Return {place of a set: numbers of its members}. In names of sets, Abaqus ignores the case of letters.

    Args:
        cards: cards of the file.
        key: "NSET" or "ELSET".
        by_card: {index of a card: numbers of the nodes or elements that this card defines}.
        of_elements: {place of a set of elements: numbers of their nodes}.
    """
    found = _cards_of_sets(cards, key)

    def members(own: _Place, outer: tuple[_Place, ...]) -> set[int]:
        together: set[int] = set()
        for k in () if own in outer else found[own]:
            numbers, others = _listed(cards[k], of_elements) if cards[k].keyword == key else (by_card.get(k, ()), ())
            together.update(numbers)
            for other in others:
                together |= members(_place_of(other, cards[k], found, "set"), (*outer, own))
        return together

    return {place: members(place, ()) for place in found}


def _sets_by_name(cards: list[_Card], key: str, members: dict[_Place, set[int]]) -> dict[str, set[int]]:
    """Return {name of a set: numbers of its members}. The first spelling of a name in the file is used."""
    names: dict[str, str] = {}
    for (_, name), own in _cards_of_sets(cards, key).items():
        names.setdefault(name, cards[own[0]].parameters[key])
    return {_full_name(cards, place, names, members): own for place, own in members.items()}


def _full_name(cards: list[_Card], at: _Place, names: dict[str, str], places: Iterable[_Place]) -> str:
    """Return the name of a set or surface. If the part and the assembly both have this name, PART. stands before the
    name of the part's set or surface.

    Args:
        cards: cards of the file.
        at: place of the set or surface.
        names: {name in small letters: first spelling of the name in the file}.
        places: places of all sets or surfaces.
    """
    inside, name = at
    part = next((card.parameters.get("NAME", "part") for _, card in _cards_of(cards, "PART")), "")
    return f"{part}.{names[name]}" if inside and (False, name) in places else names[name]


def _surfaces(
    cards: list[_Card], element_sets: dict[_Place, set[int]], blocks: dict[int, _Block]
) -> dict[str, np.ndarray]:
    """Return {name of a ``*SURFACE`` card: corners (m, 3) of its triangles}. A data line contains an element, or a set
    of elements, and one of `_FACES`. Other surfaces are ignored: surfaces of nodes or shells, analytical surfaces,
    combined or cropped surfaces, and the whole free surface (a data line without an element)."""
    tetrahedra = [block for block in blocks.values() if block.kind in ("tetra", "tetra10")]
    corners = {k: own[:4] for block in tetrahedra for k, own in zip(block.labels, block.nodes, strict=True)}
    found: dict[_Place, list[np.ndarray]] = {}
    names: dict[str, str] = {}
    for _, card in _cards_of(cards, "SURFACE"):
        combined = {"COMBINE", "CROP"} & card.parameters.keys()
        of_elements = card.parameters.get("TYPE", "ELEMENT").upper() == "ELEMENT"
        if combined or not of_elements or not all(line[0] for line in card.lines):
            continue
        name = card.parameters.get("NAME", "surface")
        names.setdefault(name.lower(), name)
        for line in card.lines:
            of, face = line[0], line[1].upper() if len(line) > 1 else ""
            if face in _FACES:
                last = of.rpartition(".")[2]  # the name of the part may stand before the number
                at = None if last.isdigit() else _place_of(of, card, element_sets, "set of elements")
                members = {int(last)} if at is None else element_sets[at]
                own = [corners[k][list(_FACES[face])] for k in sorted(members & corners.keys())]
                found.setdefault((card.inside, name.lower()), []).extend(own)
    return {_full_name(cards, at, names, found): np.array(own) for at, own in found.items() if own}


def _listed(card: _Card, of_elements: dict[_Place, set[int]]) -> tuple[set[int], list[str]]:
    """Return the numbers, and the names of other sets (in small letters), that a card of a set contains."""
    if card.keyword == "NSET" and "ELSET" in card.parameters:
        return of_elements[_place_of(card.parameters["ELSET"], card, of_elements, "set of elements")], []
    numbers, others = set(), []
    # In the assembly, numbers without the name of an instance belong to reference points.
    of_part = card.inside or "INSTANCE" in card.parameters
    for line in card.lines:
        cells = [cell for cell in line if cell]
        if "GENERATE" in card.parameters:
            numbers |= _range_of(card, cells) if cells and of_part else set()
            continue
        for cell in cells:
            last = cell.rpartition(".")[2]  # the name of the part may stand before the number
            if last.isdigit() and (of_part or last != cell):
                numbers.add(int(last))
            elif not last.isdigit():
                others.append(cell.lower())
    return numbers, others


def _nodes_of(
    element_sets: dict[_Place, set[int]], blocks: dict[int, _Block], labels: list[int]
) -> dict[_Place, set[int]]:
    """Return {place of a set of elements: numbers of the nodes of its elements}."""
    every = {own: nodes for block in blocks.values() for own, nodes in zip(block.labels, block.nodes, strict=True)}
    return {
        place: {labels[node] for own in members & every.keys() for node in every[own].tolist()}
        for place, members in element_sets.items()
    }


def _range_of(card: _Card, cells: list[str]) -> set[int]:
    """Return all numbers of a range. The data line contains the first number, the last number and the step. If the step
    is missing, it is 1."""
    if not 2 <= len(cells) <= 3 or not all(cell.isdigit() for cell in cells) or cells[2:] == ["0"]:
        raise _Wrong(f"*{card.keyword}, GENERATE has the line {','.join(cells)}; give first, last, step")
    first, last, step = (int(cell) for cell in (*cells, "1")[:3])
    return set(range(first, last + 1, step))


def _indices_of(labels: list[int], members: set[int]) -> np.ndarray:
    """Return the indices of the labels that are members. Members that are not labels are ignored."""
    return np.array([k for k, label in enumerate(labels) if label in members], int)
