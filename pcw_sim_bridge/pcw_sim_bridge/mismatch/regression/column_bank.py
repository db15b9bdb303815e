"""Whitened columns side by side, and the products of those that are asked for."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .regression_problem import FloatArray, IntArray

ROOM = 32  # columns
AT_ONCE = 64  # groups of columns that are gathered at a time


class ColumnBank:
    """Columns over the same rows, which fall into blocks; there is room for more columns to come.

    Fits take few of many columns: Gram matrices are kept of those that were asked for, and grow with them.
    """

    def __init__(self, blocks: Sequence[slice], rows: int) -> None:
        """Begin without columns."""
        self._blocks = blocks
        self._count = 0
        self._data: FloatArray = np.empty((0, rows))  # a column is a row here, in one piece of memory
        self._kept: dict[int, int] = {}  # where a column stands in the Gram matrices
        self._by_block: FloatArray = np.empty((len(blocks), 0, 0))
        self._total: FloatArray = np.empty((0, 0))
        self._products: dict[int, FloatArray] = {}  # of a column with the first in the bank, so many
        self._asked = 0

    def add(self, columns: FloatArray) -> slice:
        """Add columns (R, m); return their places."""
        before, count = self._count, self._count + columns.shape[1]
        if count > len(self._data):
            self._move(max(count + ROOM, min(2 * before, before + 8 * ROOM)))
        self._count = count
        self._data[before:count] = columns.T
        return slice(before, count)

    def reserve(self, more: int) -> None:
        """See to it that so many more columns fit without those that are there being moved again."""
        if self._count + more > len(self._data):
            self._move(self._count + more + ROOM)

    def _move(self, room: int) -> None:
        data = np.empty((room, self._data.shape[1]))
        data[: self._count] = self._data[: self._count]
        self._data = data

    def columns(self, places: IntArray) -> FloatArray:
        """Return columns (R, m) by their places."""
        return self._data[places].T

    def by_block(self, places: IntArray) -> FloatArray:
        """Gram matrices of some columns over the blocks (blocks, m, m)."""
        kept = self._keep(places)
        return self._by_block[:, kept[:, None], kept]

    def gram(self, places: IntArray) -> FloatArray:
        """Gram matrix of some columns over all rows (m, m)."""
        kept = self._keep(places)
        return self._total[kept[:, None], kept]

    def own_grams(self, places: IntArray) -> FloatArray:
        """Gram matrices (K, P, P) of K groups of columns (K, P)."""
        found = np.empty((*places.shape, places.shape[1]))
        for start in range(0, len(places), AT_ONCE):
            some = slice(start, start + AT_ONCE)
            data = [self._data[places[some, p]] for p in range(places.shape[1])]
            for p, left in enumerate(data):
                for q, right in enumerate(data[: p + 1]):
                    found[some, p, q] = found[some, q, p] = np.einsum("kr,kr->k", left, right)
        return found

    def products(self, places: IntArray, others: IntArray) -> FloatArray:
        """Products (m, K) of some columns with others, which had better always be the first in the bank."""
        end = self._asked = max(self._asked, int(others.max()) + 1)
        missing = np.array([k for k in places.tolist() if len(self._products.get(k, ())) < end], dtype=np.int64)
        if len(missing):
            self._products |= zip(missing.tolist(), self._data[missing] @ self._data[:end].T, strict=True)
        return np.stack([self._products[k][others] for k in places.tolist()])

    def rescale(self, factors: FloatArray) -> None:
        """Multiply the rows of every block by a factor (blocks,)."""
        for piece, factor in zip(self._blocks, factors, strict=True):
            self._data[: self._count, piece] *= factor
        self._by_block *= factors[:, None, None] ** 2
        self._total = self._by_block.sum(axis=0)
        self._products.clear()

    def _keep(self, places: IntArray) -> IntArray:
        """See to it that the Gram matrices hold some columns; return where."""
        new = [k for k in dict.fromkeys(places.tolist()) if k not in self._kept]
        if new:
            before, count = len(self._kept), len(self._kept) + len(new)
            self._kept |= zip(new, range(before, count), strict=True)
            if count > self._total.shape[0]:
                self._make_room(max(count + ROOM, 2 * before))
            # The first in the bank are asked for first, and need not be gathered.
            lead = next((row for row, place in enumerate(self._kept) if place != row), count)
            first, others, added = self._data[:lead], self._data[list(self._kept)[lead:]], self._data[new]
            for k, piece in enumerate(self._blocks):
                self._by_block[k, :lead, before:count] = first[:, piece] @ added[:, piece].T
                self._by_block[k, lead:count, before:count] = others[:, piece] @ added[:, piece].T
            self._by_block[:, before:count, :before] = self._by_block[:, :before, before:count].transpose(0, 2, 1)
            self._total[:count, before:count] = self._by_block[:, :count, before:count].sum(axis=0)
            self._total[before:count, :before] = self._total[:before, before:count].T
        return np.array([self._kept[k] for k in places.tolist()], dtype=np.int64)

    def _make_room(self, size: int) -> None:
        count = self._total.shape[0]
        by_block, total = np.zeros((len(self._blocks), size, size)), np.zeros((size, size))
        by_block[:, :count, :count], total[:count, :count] = self._by_block, self._total
        self._by_block, self._total = by_block, total
