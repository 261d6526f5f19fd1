"""What a run's checkpoints belong to: its settings and its photographs."""

import hashlib
import json

from engine.scene import Dataset
from engine.train.config import TrainConfig


def run_fingerprint(dataset: Dataset, config: TrainConfig) -> str:
    """Names the settings and the photographs that decide every byte of a training."""
    views = [(v.name, v.width_px, v.height_px, v.origin_world.tolist()) for v in dataset.views]
    text = json.dumps([config.model_dump(mode="json"), views, dataset.train_indices.tolist()])
    return hashlib.sha256(text.encode()).hexdigest()
