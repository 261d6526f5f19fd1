"""What a run's checkpoints belong to: its settings and its photographs."""

import hashlib
import json

from octasplat.engine.dataset import Dataset
from octasplat.engine.settings.base import dump_with_former_settings
from octasplat.engine.train.config import TrainConfig


def run_fingerprint(dataset: Dataset, config: TrainConfig) -> str:
    """Return a digest of the settings and the photographs that decide every byte of a training."""
    text = json.dumps([dump_with_former_settings(config), dataset.views_record.fingerprint()])
    return hashlib.sha256(text.encode()).hexdigest()
