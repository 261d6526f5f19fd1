"""The words that the features of a capture are compared by, and what is alike by them; both by COLMAP.

They are learnt from the capture itself, once in a search: whoever asks later, another attempt or another host
too, reads them from files in the folder of the search. A record beside them says what they were learnt from.
"""

import errno
import hashlib
import json
import os
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from octasplat.engine.core.colmap_binding import pycolmap
from octasplat.engine.core.writing import atomic_replace, write_json
from octasplat.engine.poses.stored_search import VOCABULARY_FILE, VOCABULARY_RECORD

TRAINING_DESCRIPTORS = 100_000
"""Features that the words are learnt from, drawn at random."""
MAX_WORDS = 4096
DESCRIPTORS_PER_WORD = 8
CLUSTERING_ITERATIONS = 10
_EMBEDDING_BITS = 64


def alike_by_vocabulary(
    small: Path, count: int, queries: Sequence[int], most: int, *, seed: int
) -> Iterator[tuple[int, list[int]]]:
    """Yield photographs by their numbers, each with those that are most alike by a vocabulary, in order.

    Args:
        small: database of the photographs with their largest features only; the vocabulary is beside it.
        count: photographs in all.
        queries: numbers of those to yield.
        most: photographs for each of them.
        seed: of the vocabulary.

    Raises:
        DiskFullError: there is no room for the vocabulary.
    """
    with pycolmap.Database.open(small) as photographs:
        descriptors = _drawn_descriptors(photographs, count, seed)
        if len(descriptors) < 2 * DESCRIPTORS_PER_WORD:
            return
        pairing = pycolmap.VocabTreePairingOptions()
        pairing.vocab_tree_path = _find_vocabulary(small.parent, descriptors, seed)
        pairing.num_images = most
        pairing.num_threads = 1  # votes are the same on any number of threads then
        generator = pycolmap.VocabTreePairGenerator(pairing, photographs, list(queries))
        while not generator.has_finished():
            # pairs of one photograph with those that it asks for, the most alike first
            pairs = [pair for pair in generator.next() if pair[0] != pair[1]]
            if pairs:
                yield pairs[0][0], [other for _, other in pairs]


def _find_vocabulary(work: Path, descriptors: Float32[np.ndarray, "d 128"], seed: int) -> Path:
    """Return the file of the words of these features, which are learnt unless they are there.

    Two files cannot be replaced in one step, so that the record also knows the words by their digest.
    """
    vocabulary, record = work / VOCABULARY_FILE, work / VOCABULARY_RECORD
    words = min(MAX_WORDS, len(descriptors) // DESCRIPTORS_PER_WORD)
    learnt_from = {
        "descriptors_sha256": hashlib.sha256(descriptors.tobytes()).hexdigest(),
        "words": words,
        "iterations": CLUSTERING_ITERATIONS,
        "seed": seed,
    }
    if _read_record(record) == {**learnt_from, "sha256": _sha256(vocabulary)}:
        return vocabulary
    _learn(vocabulary, descriptors, words, seed)
    write_json(record, {**learnt_from, "sha256": _sha256(vocabulary)})
    return vocabulary


def _learn(vocabulary: Path, descriptors: Float32[np.ndarray, "d 128"], words: int, seed: int) -> None:
    """Learn so many words and write them."""
    options = pycolmap.VisualIndex.BuildOptions()
    options.num_visual_words = words
    options.num_iterations = CLUSTERING_ITERATIONS
    options.num_rounds = 1
    options.num_threads = 1  # sums are the same on any number of threads then
    features = pycolmap.FeatureDescriptorsFloat()
    features.type = pycolmap.FeatureExtractorType.SIFT
    features.data = descriptors
    pycolmap.set_random_seed(seed)
    index = pycolmap.VisualIndex.create(descriptors.shape[1], _EMBEDDING_BITS)
    index.build(options, features)
    with atomic_replace(vocabulary) as new:
        # of a full disk COLMAP tells at some places only, but it does not read what is cut short
        try:
            index.write(new)
            pycolmap.VisualIndex.read(new)
        except (ValueError, RuntimeError) as error:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)) from error


def _read_record(record: Path) -> object:
    try:
        return json.loads(record.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None


def _sha256(path: Path) -> str | None:
    """Return the digest of a file of a few megabytes; None where there is none."""
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError:
        return None


def _drawn_descriptors(
    photographs: "pycolmap.Database", count: int, seed: int
) -> Float32[np.ndarray, "d 128"]:
    """Return features drawn evenly from all photographs."""
    rng = np.random.Generator(np.random.PCG64(seed))
    each = max(1, TRAINING_DESCRIPTORS // count)
    drawn = [np.zeros((0, 128), np.float32)]
    for number in range(1, count + 1):
        if photographs.exists_descriptors(number):
            data = photographs.read_descriptors(number).data
            chosen = rng.permutation(len(data))[:each]
            drawn.append(data[np.sort(chosen)].astype(np.float32))
    return np.concatenate(drawn)
