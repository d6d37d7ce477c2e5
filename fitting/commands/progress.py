"""The progress bar of a fit, with its cost."""

from collections.abc import Callable

from tqdm import tqdm


def cost_bar(unit: str, description: str | None = None) -> tuple[tqdm, Callable[[int, float], None]]:
    """A bar on standard error, off when that is not a terminal, and the function to call with the cost."""
    bar = tqdm(desc=description, unit=f" {unit}", disable=None, leave=False)

    def told(_: int, cost: float) -> None:
        bar.set_postfix(cost=f"{cost:.4g}")
        bar.update()

    return bar, told
