"""Progress bars of fits: with the cost of one fit, or with what is fitted at the moment."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from tqdm import tqdm


def cost_bar(unit: str, description: str | None = None) -> tuple[tqdm, Callable[[int, float], None]]:
    """A bar on standard error, off when that is not a terminal, and the function to call with the cost."""
    bar = tqdm(desc=description, unit=f" {unit}", disable=None, leave=False)

    def told(_: int, cost: float) -> None:
        bar.set_postfix(cost=f"{cost:.4g}")
        bar.update()

    return bar, told


@contextmanager
def named_bar(description: str) -> Iterator[Callable[[str], None]]:
    """A bar on standard error, off when that is not a terminal: the function to call with the name of the next fit."""
    with tqdm(desc=description, unit=" fits", disable=None, leave=False) as bar:

        def told(text: str) -> None:
            bar.set_postfix_str(text)
            bar.update()

        yield told
