"""Progress bars of fits: they show the cost of one fit, or the name of the current fit."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from tqdm import tqdm


def cost_bar(unit: str, description: str | None = None) -> tuple[tqdm, Callable[[int, float], None]]:
    """Return a progress bar on standard error, and a function that must be called with every new cost. The bar is off
    if standard error is not a terminal."""
    bar = tqdm(desc=description, unit=f" {unit}", disable=None, leave=False)

    def told(_: int, cost: float) -> None:
        bar.set_postfix(cost=f"{cost:.4g}")
        bar.update()

    return bar, told


@contextmanager
def named_bar(description: str) -> Iterator[Callable[[str], None]]:
    """Show a progress bar on standard error. Yields a function that must be called with the name of each fit. The bar
    is off if standard error is not a terminal."""
    with tqdm(desc=description, unit=" fits", disable=None, leave=False) as bar:

        def told(text: str) -> None:
            bar.set_postfix_str(text)
            bar.update()

        yield told
