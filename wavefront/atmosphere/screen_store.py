"""Memory of the phase screens of an atmosphere, shared by all atmospheres of the same turbulence."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any
from weakref import WeakSet

import numpy as np

from .screens import in_whole_blocks

# Screens are made one set at a time, by all threads: each takes working memory of its own size.
_making_lock = threading.Lock()


class ScreenStore:
    """Screens of the layers, each row made once.

    An atmosphere uses the store from its first call of :meth:`screens` to its :meth:`release`, or its own end. The
    screens are freed by a :meth:`release` that leaves no user, and with the store. Copies and pickles of it are empty.

    Parameters
    ----------
    key : tuple
        All that determines the screens; the default is that of no atmosphere.
    """

    def __init__(self, key: tuple[Any, ...] = ()) -> None:
        self.key = key
        self._users: WeakSet[Any] = WeakSet()
        self._screens: dict[str, np.ndarray] = {}
        self._made_rows: dict[str, np.ndarray] = {}

    def __reduce__(self) -> tuple[Any, ...]:
        return ScreenStore, (self.key,)

    def screens(
        self,
        user: Any,
        kind: str,
        allocate: Callable[[], np.ndarray],
        make: Callable[..., Any],
        rows: np.ndarray | None = None,
    ) -> np.ndarray:
        """Return the screens of a kind, not writable, with at least the given rows [n_layer, size]; by default all.

        ``allocate`` returns memory for them, [n_layer, size, size]; ``make`` fills a layer, by its index, into ``out``,
        all of it or the given ``rows``. A second call that lacks some rows makes all of them.
        """
        with _making_lock:
            self._users.add(user)
            if kind not in self._screens:
                screens = allocate()[:]
                screens.setflags(write=False)
                self._screens[kind], self._made_rows[kind] = screens, np.zeros(screens.shape[:2], dtype=bool)
            screens, made_rows = self._screens[kind], self._made_rows[kind]
            base: Any = screens.base
            needed_rows = np.ones(made_rows.shape, dtype=bool) if rows is None else rows
            lacking = (needed_rows & ~made_rows).any(axis=1)
            if made_rows.any():
                needed_rows = np.ones(made_rows.shape, dtype=bool)
            for layer in np.flatnonzero(lacking):
                new_rows = in_whole_blocks(needed_rows[layer] & ~made_rows[layer])
                only: dict[str, Any] = {} if new_rows.all() else {"rows": new_rows}
                make(int(layer), out=base[layer], **only)
                made_rows[layer] |= new_rows
            return screens

    def made_rows(self, kind: str) -> np.ndarray:
        """Return which rows of the screens of a kind are made, bool [n_layer, size]."""
        return self._made_rows[kind]

    def release(self, user: Any) -> None:
        """End the use by an atmosphere; the screens are freed where no other one uses them."""
        with _making_lock:
            self._users.discard(user)
            if not self._users:
                self._screens.clear()
                self._made_rows.clear()
