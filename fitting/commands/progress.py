"""Progress bars of fits: they show the cost of one fit, or the name of the current fit."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from tqdm import tqdm


def cost_bar(unit: str, description: str | None = None) -> tuple[tqdm, Callable[[int, float], None]]:
    """A bar on standard error (off if that is not a terminal), and the function to call with every cost."""
    bar = tqdm(desc=description, unit=f" {unit}", disable=None, leave=False)

    def told(_: int, cost: float) -> None:
        bar.set_postfix(cost=f"{cost:.4g}")
        bar.update()

    return bar, told


@contextmanager
def named_bar(description: str) -> Iterator[Callable[[str], None]]:
    """A bar on standard error (off if that is not a terminal); it gives the function to call with each fit's name."""
    with tqdm(desc=description, unit=" fits", disable=None, leave=False) as bar:

        def told(text: str) -> None:
            bar.set_postfix_str(text)
            bar.update()

        yield told
