"""Hooks of schemathesis: most requests name things that exist, or nothing but 404 would be met.

``OCTASPLAT_TEST_IDS`` names a file that maps each path parameter to ids. Those under ``used`` may be changed
and deleted, so each serves one request; those under ``kept`` are for reading. Requests that follow links name
what came of those before them. ZIP files are scenes, sound ones and ones that lie.

With ``OCTASPLAT_TEST_THINNED`` each place in a body has one request for each way of being wrong there,
whatever alternatives the place is in. Every option of every kind of job with each of five wrong types would
be four fifths of all requests.
"""

import itertools
import json
import os
import re
import threading
from pathlib import Path
from typing import Any

import schemathesis
from hypothesis import strategies as st
from schemathesis.core.parameters import ParameterLocation
from schemathesis.generation.meta import TestPhase

from tests.support.model_builder import ColmapModelBuilder, photographs
from tests.support.zip_builder import ZipMember, build_zip

_IDS = json.loads(Path(os.environ["OCTASPLAT_TEST_IDS"]).read_text())
_USED = {name: itertools.cycle(ids) for name, ids in _IDS["used"].items()}
_KEPT = {name: itertools.cycle(ids) for name, ids in _IDS["kept"].items()}
_COUNT = itertools.count()
_SCENE = {**photographs(), **ColmapModelBuilder().files()}
_FIELDS = st.dictionaries(
    st.sampled_from(("flags", "method", "crc", "packed", "size", "start", "disk", "version")),
    st.integers(0, 0xFFFF),
    max_size=2,
)

_IS_THINNED = "OCTASPLAT_TEST_THINNED" in os.environ
_ALTERNATIVES = re.compile(r"/(?:anyOf|oneOf|allOf)/\d+")
_SEEN: set[tuple[object, ...]] = set()
_LOCK = threading.Lock()


@schemathesis.hook
def filter_case(_context: schemathesis.HookContext, case: schemathesis.Case) -> bool:
    if not _IS_THINNED or case.meta is None or case.meta.phase.name != TestPhase.COVERAGE:
        return True
    data: Any = case.meta.phase.data
    if data.parameter_location != ParameterLocation.BODY:
        return True
    place = _ALTERNATIVES.sub("", data.location) if data.location else data.description
    key = (case.operation.label, data.scenario, place)
    with _LOCK:
        is_new = key not in _SEEN
        _SEEN.add(key)
    return is_new


@schemathesis.hook
def before_call(_context: schemathesis.HookContext, case: schemathesis.Case, **_kwargs: Any) -> None:
    follows = case.meta is not None and case.meta.phase.name == TestPhase.STATEFUL
    if follows or next(_COUNT) % 8 == 0 or not case.path_parameters:
        return
    pool = _KEPT if case.method.upper() in ("GET", "HEAD") else _USED
    for name in case.path_parameters:
        if name in pool:
            case.path_parameters[name] = next(pool[name])


@st.composite
def scenes(draw: st.DrawFn) -> bytes:
    """A scene as a ZIP file: as it should be, with entries of other names and contents, lying, or damaged."""
    contents = dict(_SCENE)
    for name in draw(st.lists(st.sampled_from(sorted(contents)), max_size=2)):
        contents[name] = draw(st.binary(max_size=64))
    entries = [ZipMember(name, content) for name, content in contents.items()]
    for name in draw(st.lists(st.one_of(st.text(max_size=20), st.binary(max_size=20)), max_size=2)):
        method, mode = draw(st.sampled_from((0, 8, 9, 99))), draw(st.sampled_from((0o100644, 0o120777, 0)))
        content = draw(st.binary(max_size=64))
        entries.append(
            ZipMember(name, content, method=method, mode=mode, local=draw(_FIELDS), central=draw(_FIELDS))
        )
    end = draw(
        st.one_of(
            st.none(), st.dictionaries(st.sampled_from(("entries", "size", "start")), st.integers(0, 9999))
        )
    )
    archive = bytearray(build_zip(*entries, suffix=draw(st.sampled_from((b"", b"", b"x"))), end=end))
    for place, value in draw(
        st.lists(st.tuples(st.integers(0, len(archive) - 1), st.integers(0, 255)), max_size=3)
    ):
        archive[place] = value
    return bytes(archive)


whole = st.just(build_zip(*(ZipMember(name, content) for name, content in _SCENE.items())))
schemathesis.openapi.media_type("application/zip", st.one_of(whole, scenes(), st.binary(max_size=200)))
