"""A progress bar where one is wanted."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def progress(total: int, unit: str, shown: bool) -> Iterator[Callable[[int], Any]]:
    """
    :param total: where it ends
    :param unit: of what
    :param shown: False: nothing is shown
    :return: what is to be called with how many more there are
    """
    if not shown:
        yield lambda n: None
        return
    from tqdm import tqdm

    with tqdm(total=total, unit=unit) as bar:
        yield bar.update
