"""``liverjax play SCENE.toml``: show the moving body in a browser, where the user can pull it with the mouse."""

import argparse
import time
from pathlib import Path
from typing import TYPE_CHECKING

from liverjax.core.errors import InputError

if TYPE_CHECKING:
    from liverjax.play.pulling import Playing


def add(parsers: argparse._SubParsersAction) -> None:
    """Add the command to the parser."""
    command = parsers.add_parser(
        "play",
        help="pull a body with the mouse in a browser",
        description="Serve a page on this machine that shows the body of a scene. One step is computed per picture. "
        "The user can pull the body with the mouse.",
    )
    command.add_argument("scene", type=Path, metavar="SCENE.toml")
    command.add_argument(
        "--port", type=int, default=8765, metavar="N", help="port of the page (default 8765; 0 selects any free port)"
    )
    command.add_argument("--no-browser", action="store_true", help="do not open the page")
    command.add_argument(
        "--steps",
        type=int,
        metavar="N",
        help="without a page, pull the body for N steps and print the number of steps per second",
    )
    command.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Serve the page until Ctrl-C, or run a number of steps without a page."""
    if not 0 <= options.port < 65536:
        raise InputError(f"--port {options.port} is not the number of a port: give 0 to 65535")
    if options.steps is not None and options.steps < 1:
        raise InputError(f"--steps {options.steps} must be above 0: give e.g. 100")
    from liverjax.play import pulling
    from liverjax.scenes import scene_file

    playing = pulling.at_rest(scene_file.load_scene(options.scene))
    if options.steps is not None:
        return _without_page(playing, options.steps)
    from liverjax.play.server import PlayServer

    try:
        server = PlayServer(playing, options.port)
    except OSError as error:
        raise InputError(f"--port {options.port} cannot be used ({error.strerror}): give another port") from None
    print(f"{server.address}  (Ctrl-C ends)", flush=True)
    if not options.no_browser:
        import webbrowser

        webbrowser.open(server.address)
    with server:
        server.serve_forever()
    return 0


def _without_page(playing: "Playing", steps: int) -> int:
    """Pull one surface node by a tenth of the body's size: the node farthest from the centre of the fixed nodes. Return
    1 if a step failed."""
    import numpy as np

    from liverjax.core import status
    from liverjax.play import pulling

    X = playing.positions
    scene = playing.scene
    held = [np.asarray(f.nodes) for f in scene.fixed] + [np.asarray(d.nodes) for d in scene.displaced]
    centre = X[np.concatenate(held)].mean(axis=0) if held else X.mean(axis=0)
    nodes = np.setdiff1d(playing.nodes, np.concatenate(held)) if held else playing.nodes
    if not len(nodes):
        raise InputError("[[fixed]] and [[displaced]] contain the whole surface: leave at least one surface node free")
    node = int(nodes[np.argmax(np.linalg.norm(X[nodes] - centre, axis=1))])
    away = X[node] - centre
    to = X[node] + 0.1 * playing.size * away / max(float(np.linalg.norm(away)), 1e-300)
    failed, taken = 0, []
    for _ in range(steps):
        begin = time.perf_counter()
        playing = pulling.pulled(playing, node, to, playing.stiffness)
        taken.append(time.perf_counter() - begin)
        failed += playing.code not in (status.CONVERGED, status.ONE_STEP)
    moved = float(np.linalg.norm(playing.positions[node] - X[node]))
    print(
        f"{len(X)} nodes, {steps} steps, {1 / np.median(taken):.3g} per second (slowest {1e3 * max(taken):.3g} ms), "
        f"node {node} moved {1e3 * moved:.3g} mm" + (f"; {failed} steps failed" if failed else "")
    )
    return 1 if failed else 0
