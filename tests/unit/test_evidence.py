"""Data that a model was not fitted to: blocks of a record, each predicted from the rest."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from flexid_cli.diagnose.evidence import FOLD_BLOCKS, FOLDS, cross_validated

ROWS = 2000


def fitted(columns, y, equations=1):
    return SimpleNamespace(
        y=y, basis=SimpleNamespace(columns=columns), problem=SimpleNamespace(equations=equations)
    )


def test_what_a_model_explains_is_predicted():
    rng = np.random.default_rng(1)
    columns = rng.standard_normal((2 * ROWS, 3))
    left = cross_validated(fitted(columns, columns @ [1.0, -2.0, 0.5], equations=2))
    assert np.max(np.abs(left)) < 1e-10


def test_what_stands_in_one_block_only_is_not():
    """A column of a single block is free there: a fit takes all of it, a prediction none."""
    rng = np.random.default_rng(2)
    only = np.zeros(ROWS)
    only[: ROWS // FOLD_BLOCKS] = rng.standard_normal(ROWS // FOLD_BLOCKS)
    columns = np.column_stack([rng.standard_normal(ROWS), only])
    left = cross_validated(fitted(columns, 3.0 * only))
    assert left == pytest.approx(3.0 * only, abs=1e-10)


def test_a_sweep_is_predicted_from_its_neighbours():
    """Two columns that change places slowly: halves of the record would know of one of them only."""
    share = np.linspace(0.0, 1.0, ROWS)
    rng = np.random.default_rng(3)
    columns = rng.standard_normal((ROWS, 2)) * np.column_stack([1.0 - share, share]) ** 8
    noise = rng.standard_normal(ROWS)
    left = cross_validated(fitted(columns, columns @ [1.0, 1.0] + noise))
    assert np.sqrt(np.mean(left**2)) < 1.1 * np.sqrt(np.mean(noise**2))


def test_folds_are_made_of_blocks_all_over_the_record():
    assert FOLD_BLOCKS % FOLDS == 0
    assert FOLD_BLOCKS // FOLDS >= 4
