"""Decoding runs ahead of computation, one by one or in batches."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

T = TypeVar("T")


def read_ahead(items: Iterable[T], depth: int = 8) -> Iterator[T]:
    """Iterate over `items` in a thread that stays up to `depth` items ahead of the consumer.

    It pays where making an item releases the interpreter lock, as image and video decoding do. One thread takes the
    items one by one, so that any iterable will do and the order stays.

    Parameters
    ----------
    items : iterable
        Read only from that thread. Nothing is read before the first item is asked for.
    depth : int
        Items that may wait, at least 1.

    Yields
    ------
    object
        The items in order. An exception of `items` is raised where its item would have come.
        Closing the generator waits for the item in the making and ends the thread.

    Examples
    --------
    >>> list(read_ahead(range(3)))
    [0, 1, 2]
    """
    iterator, end = iter(items), object()
    pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix="read_ahead")
    try:
        waiting: deque[Future[T | object]] = deque(pool.submit(next, iterator, end) for _ in range(max(depth, 1)))
        while (item := waiting.popleft().result()) is not end:
            waiting.append(pool.submit(next, iterator, end))
            yield item  # type: ignore[misc]
    finally:
        pool.shutdown(cancel_futures=True)


def in_batches(items: Iterable[T], size: int) -> Iterator[list[T]]:
    """Put `items` together into lists of `size`; the last one may be shorter.

    Where `items` raises, what came before is yielded first.

    Examples
    --------
    >>> list(in_batches(range(5), 2))
    [[0, 1], [2, 3], [4]]
    """
    batch: list[T] = []
    try:
        for item in items:
            batch.append(item)
            if len(batch) == size:
                yield batch
                batch = []
    except Exception:  # nothing is swallowed: what was read before the error is handed on, then it goes on its way
        if batch:
            yield batch
        raise
    if batch:
        yield batch
