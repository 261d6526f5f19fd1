"""The split of a scene: by rule, by names, or as the scene says, with copies of photographs on one side."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from jaxtyping import Int64

from octasplat.engine.dataset.model import DatasetModel
from octasplat.engine.dataset.split import split_views

if TYPE_CHECKING:
    from octasplat.engine.dataset.duplicates import Duplicates

SplitSource = Literal["given", "every"]


@dataclass(frozen=True)
class SplitRule:
    """Rule that chooses the held-out views.

    Attributes:
        test_every: hold out every N-th view, starting with the first; 0 holds out none.
        held_out: names of the views to hold out instead.
        burst_length: so many views that follow each other by name count as one.
        split: ``given`` holds out what the scene says, where it says anything and neither ``held_out`` nor a
            ``test_every`` of 0 says otherwise; ``every`` does not ask the scene.
        stored: whether each view is held out by a run that was begun before; taken as it is, whatever the
            rule says now, where the scene has just these views.
    """

    test_every: int = 8
    held_out: Sequence[str] | None = None
    burst_length: int = 1
    split: SplitSource = "given"
    stored: Mapping[str, bool] | None = None


@dataclass(frozen=True, eq=False)
class SceneSplit:
    """Indices of the views to train on and of those held out, and sentences on how it came about."""

    train_indices: Int64[np.ndarray, " train"]
    test_indices: Int64[np.ndarray, " test"]
    warnings: tuple[str, ...] = ()


def split_scene(model: DatasetModel, rule: SplitRule) -> SceneSplit:
    """Return the split of a scene.

    Raises:
        DatasetError: a name to hold out is unknown, or nothing is left to train on.
        ConfigError: ``test_every`` is negative.
    """
    from octasplat.engine.dataset.duplicates import find_duplicates  # here, as it decodes photographs

    names = [view.name for view in model.views]
    if rule.stored is not None and rule.stored.keys() == set(names):
        return _stored_split(names, rule.stored, find_duplicates(model))
    held_out = rule.held_out
    warnings: list[str] = []
    if model.held_out is not None:
        of_scene = f"{model.model_folder} holds out {len(model.held_out)} views"
        if held_out is None and rule.test_every and rule.split == "given":
            held_out = model.held_out
            instead = "split=every holds out every n-th view instead."
            warnings.append(
                f"{of_scene}, which are measured; {instead}"
                if held_out
                else f"{model.model_folder} holds out no views, so nothing is measured; {instead}"
            )
        else:
            warnings.append(f"{of_scene}; this run holds out others, as asked.")
    duplicates = find_duplicates(model)
    if (sentence := duplicates.sentence(names)) is not None:
        warnings.append(sentence)
    train, test = split_views(
        names, rule.test_every, held_out, burst_length=rule.burst_length, duplicates=duplicates.groups
    )
    return SceneSplit(train, test, tuple(warnings))


def _stored_split(names: Sequence[str], stored: Mapping[str, bool], duplicates: "Duplicates") -> SceneSplit:
    is_test = np.array([stored[name] for name in names], bool)
    apart = [group for group in duplicates.groups if len(set(is_test[list(group)].tolist())) == 2]
    if not apart:
        return SceneSplit(np.flatnonzero(~is_test), np.flatnonzero(is_test))
    shown = " = ".join(names[index] for index in apart[0])
    warning = (
        f"{len(apart)} photographs are there more than once, on both sides of the split that the run was "
        f"begun with ({shown}, for instance), so that its figures measure memory in part; a new run keeps "
        "them on one side."
    )
    return SceneSplit(np.flatnonzero(~is_test), np.flatnonzero(is_test), (warning,))
