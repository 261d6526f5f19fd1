"""What operators and laptops do to a service, done to it while jobs run and clients send photographs.

    python -m benchmarks.chaos_upheavals     # prints a report as JSON; exit code 1 if there are faults

The front end is started again during uploads; the clock of the database jumps forth and back; tables are
changed during a backup; every table gets a further column, as of a next version beside which this one goes
on. What must hold at the end is what :mod:`benchmarks.chaos` demands of jobs, and besides:

* every command of a client has succeeded, and what it sent and fetched is whole;
* no attempt was taken from its worker, and no worker has ended;
* the backup can be restored, and the tables count every byte right.
"""

import argparse
import hashlib
import json
import os
import random
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import psycopg
from PIL import Image
from psycopg import sql

from benchmarks.chaos import Run, make_scene
from benchmarks.chaos_kind import ChainOptions, undisturbed
from benchmarks.chaos_machine import ROOT, Machine
from octasplat.workers.client.upload import list_scene_files, upload_scene
from octasplat.workers.db.migrate import OWN_COMPONENT, Migration, apply_step
from octasplat.workers.postgres.embedded import EmbeddedPostgres

STEPS, STEP_SECONDS = 60, 0.1
CLIENTS, PHOTOGRAPHS, SIDE_PX = 3, 8, 1000
COMMAND_SECONDS = 300.0
LONGEST_ANSWER_SECONDS = 10.0
"""A request may wait so long while tables are changed; one try of a step takes two seconds at most."""
JUMP_SECONDS = 7200
ABSENT = "absent"
"""A queue that no worker takes, for jobs that only have to be accepted."""
COLUMN = "ALTER TABLE {} ADD COLUMN {} text NOT NULL DEFAULT 'x';"


@dataclass
class Upheavals:
    """A run of them.

    Args:
        run: the machine and its jobs.
        folder: for what clients send and fetch, and for the backup.
        commands: every command of a client that has ended: its words, its exit code and its last words.
        seconds: how long each upheaval took.
        faults: what was wrong, in sentences.
        longest_answer_seconds: how long a request waited at most while tables were changed.
        front_ends_ended: how often the front end was ended.
    """

    run: Run
    folder: Path
    commands: list[tuple[str, int, str]] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=dict)
    faults: list[str] = field(default_factory=list)
    longest_answer_seconds: float = 0.0
    front_ends_ended: int = 0

    @property
    def machine(self) -> Machine:
        """What they are done to."""
        return self.run.machine

    def connect(self) -> "psycopg.Connection[Any]":
        """A connection to the service's database."""
        conninfo = EmbeddedPostgres(self.machine.data).conninfo()
        return psycopg.connect(conninfo, autocommit=True)

    def command(self, *words: str) -> str:
        """Run a command and return what it says."""
        environment = {
            **os.environ, "OCTASPLAT_SERVER": self.machine.address, "OCTASPLAT_TOKEN": self.machine.token,
        }  # fmt: skip
        environment.pop("DATABASE_URL", None)
        done = subprocess.run(
            [sys.executable, "-m", "octasplat", *words],
            env=environment, cwd=ROOT, capture_output=True, text=True, timeout=COMMAND_SECONDS, check=False,
        )  # fmt: skip
        self.commands.append((" ".join(words[:2]), done.returncode, done.stderr[-500:]))
        if done.returncode:
            self.faults.append(
                f"octasplat {' '.join(words)} ended with {done.returncode}: {done.stderr[-500:]}"
            )
        return done.stdout

    def do(self, upheaval: "Callable[[Upheavals], None]") -> None:
        """Do one of them while chains run, and note how long it took."""
        while self.run.in_flight() < 2 * self.machine.slots:
            self.run.submit_chain(STEPS, STEP_SECONDS)
        self.run.in_flight_before.append(self.run.in_flight())
        self.run.blows[upheaval.__name__] += 1
        began = time.monotonic()
        upheaval(self)
        self.seconds[upheaval.__name__] = round(time.monotonic() - began, 1)

    def end_front_end(self, *, kindly: bool) -> None:
        """End the front end, which is started again."""
        deadline = time.monotonic() + COMMAND_SECONDS
        while not (ended := self.machine.front_end()) and time.monotonic() < deadline:
            time.sleep(0.05)  # it has just been ended, and is being started again
        for process in ended:
            process.terminate() if kindly else process.kill()
        self.front_ends_ended += len(ended)
        psutil.wait_procs(ended, timeout=60)

    def change_tables(self, name: str, tables: list[str]) -> None:
        """Apply a step as a next version would, while a request after the other is made."""
        column = sql.Identifier(f"of_{name}")
        with self.connect() as connection:
            text = sql.SQL("").join(sql.SQL(COLUMN).format(sql.Identifier(t), column) for t in tables)
            step = Migration(OWN_COMPONENT, f"9999_{name}.sql", text.as_string(connection))
            changing = threading.Thread(target=apply_step, args=(connection, step))
            changing.start()
            while changing.is_alive():
                began = time.monotonic()
                self.run.in_flight()
                self.longest_answer_seconds = max(self.longest_answer_seconds, time.monotonic() - began)
                time.sleep(0.02)
            if connection.execute("SELECT FROM schema_steps WHERE name = %s", [step.name]).fetchone() is None:
                self.faults.append(f"the step {step.name} was not applied")


def restart_front_end_during_uploads(those: Upheavals) -> None:
    """End the front end in good order, and then at once, while clients send photographs."""
    scenes = [_photographs(those.folder / f"sent{number}", number) for number in range(CLIENTS)]
    clients = [
        threading.Thread(target=those.command, args=("submit", str(scene), "--queue", ABSENT))
        for scene in scenes
    ]
    for client in clients:
        client.start()
    for share in (0.2, 0.6):
        while _files_there(those) < share * CLIENTS * PHOTOGRAPHS:
            time.sleep(0.02)
        if _files_there(those) >= CLIENTS * PHOTOGRAPHS:
            those.faults.append("the uploads were over before the front end was ended")
        those.end_front_end(kindly=share < 0.5)
    for client in clients:
        client.join()
    sent = sorted(hashlib.sha256(path.read_bytes()).hexdigest() for s in scenes for path in s.iterdir())
    with those.connect() as connection:
        rows = connection.execute(
            "SELECT f.sha256 FROM dataset_files f JOIN jobs ON jobs.dataset_id = f.dataset_id "
            "WHERE jobs.queue = %s ORDER BY 1", [ABSENT],
        ).fetchall()  # fmt: skip
    if [sha256 for (sha256,) in rows] != sent:
        those.faults.append(
            f"{len(sent)} photographs were sent in {CLIENTS} scenes, and {len(rows)} are there"
        )
    for job in those.run.patiently(lambda api: list(api.iterate_pages("/v1/jobs", "jobs", state=["queued"]))):
        if job["queue"] == ABSENT:
            those.command("cancel", job["id"])
            those.run.patiently(lambda api, job=job: api.request("DELETE", f"/v1/jobs/{job['id']}"))


def jump_clock(those: Upheavals) -> None:
    """Let the database's clock jump forth, as after a sleep, and later back.

    It is all the same whether the clock jumps or every time that was ever written.
    """
    for seconds in (-JUMP_SECONDS, JUMP_SECONDS):
        with those.connect() as connection:
            # No trigger counts or tells anything for it.
            connection.execute("SET session_replication_role = replica")
            columns: dict[str, list[str]] = {}
            for table, column in connection.execute(
                "SELECT table_name, column_name FROM information_schema.columns "
                "JOIN information_schema.tables USING (table_schema, table_name) "
                "WHERE table_schema = 'public' AND table_type = 'BASE TABLE' "
                "AND data_type = 'timestamp with time zone'"
            ):
                columns.setdefault(table, []).append(column)
            for table, names in columns.items():
                changes = sql.SQL(", ").join(
                    sql.SQL("{0} = {0} + make_interval(secs => {1})").format(sql.Identifier(name), seconds)
                    for name in names
                )
                connection.execute(sql.SQL("UPDATE {} SET {}").format(sql.Identifier(table), changes))
        time.sleep(5)  # whoever looks for lost jobs has looked several times


def change_tables_during_backup(those: Upheavals) -> None:
    """Change the tables of a service that is just being copied."""
    folder = those.folder / "backup"
    backing = threading.Thread(
        target=those.command, args=("backup", str(folder), "--data", str(those.machine.data))
    )
    backing.start()
    while not any(folder.glob("*/*.copy")) and backing.is_alive():
        time.sleep(0.005)
    those.change_tables("during_backup", ["jobs", "datasets", "dataset_files", "artifacts"])
    backing.join()


def add_columns(those: Upheavals) -> None:
    """Give every table a column that this version does not know, and start the front end on them."""
    with those.connect() as connection:
        found = connection.execute(
            "SELECT tablename FROM pg_tables WHERE schemaname = 'public' "
            "AND tablename NOT LIKE 'procrastinate%' ORDER BY 1"
        ).fetchall()
    those.change_tables("upgrade", [table for (table,) in found])
    those.end_front_end(kindly=True)


UPHEAVALS: tuple[Callable[[Upheavals], None], ...] = (
    restart_front_end_during_uploads, jump_clock, change_tables_during_backup, add_columns,
)  # fmt: skip


def upheave(run: Run, folder: Path) -> Upheavals:
    """Do all of them, fetch a result, and look for faults."""
    those = Upheavals(run, folder)
    listed = run.patiently(lambda api: list_scene_files(api, run.scene))
    run.photographs = {file.name: file.path.read_bytes() for file in listed}
    run.dataset = run.patiently(lambda api: upload_scene(api, run.scene))["id"]
    workers = {process.pid for process in run.machine.kept()} - {p.pid for p in run.machine.front_end()}
    run.submit_chain(STEPS, STEP_SECONDS)
    (first,) = run.accepted
    # One command waits all the time.
    gate = folder / "gate"
    run.submit_chain(STEPS, STEP_SECONDS, gate=str(gate))
    held = next(job for job in run.accepted if job != first)
    waiting = threading.Thread(target=those.command, args=("status", held, "--wait"))
    waiting.start()
    for upheaval in UPHEAVALS:
        those.do(upheaval)
    gate.touch()
    run.settle(300)
    waiting.join()
    those.command("download", first, "-o", str(folder / "fetched"))
    expected = undisturbed(run.photographs, ChainOptions.model_validate(run.accepted[first]["options"]))
    if (folder / "fetched" / "chain.bin").read_bytes() != expected:
        those.faults.append("a result that was fetched is not that of an undisturbed run")
    those.faults += run.faults()
    _look_at_the_end(those, workers)
    return those


def report(those: Upheavals) -> dict[str, Any]:
    """Numbers of the run."""
    return {
        **those.run.report(),
        "seconds": those.seconds,
        "commands": len(those.commands),
        "commands_failed": sum(code != 0 for _, code, _ in those.commands),
        "front_ends_ended": those.front_ends_ended,
        "longest_answer_seconds": round(those.longest_answer_seconds, 2),
    }


def _look_at_the_end(those: Upheavals, workers: set[int]) -> None:
    """Look at what no single job tells."""
    alive = {process.pid for process in those.machine.kept()}
    if not workers or workers - alive:
        those.faults.append(f"{len(workers - alive)} of {len(workers)} workers have ended")
    if those.longest_answer_seconds > LONGEST_ANSWER_SECONDS:
        those.faults.append(f"a request waited {those.longest_answer_seconds:.1f} s for tables")
    if those.front_ends_ended != 3:
        those.faults.append(f"the front end was ended {those.front_ends_ended} times in the place of three")
    numbers = those.run.report()
    if numbers["attempts"] != numbers["jobs"]:
        those.faults.append(f"{numbers['jobs']} jobs took {numbers['attempts']} attempts")
    with those.connect() as connection:
        if wrong := connection.execute("SELECT * FROM octasplat_recount()").fetchall():
            those.faults.append(f"bytes were counted wrong: {wrong}")
    those.command("fsck", "--data", str(those.machine.data))
    restored = those.folder / "restored"
    those.command("restore", str(those.folder / "backup"), "--data", str(restored))


def _photographs(folder: Path, seed: int) -> Path:
    """Photographs of noise, which no format makes small."""
    folder.mkdir()
    chance = np.random.default_rng(seed)
    for number in range(PHOTOGRAPHS):
        pixels = chance.integers(0, 256, (SIDE_PX, SIDE_PX, 3), dtype=np.uint8)
        Image.fromarray(pixels).save(folder / f"{number}.png", compress_level=0)
    return folder


def _files_there(those: Upheavals) -> int:
    with those.connect() as connection:
        query = "SELECT count(*) FROM dataset_files WHERE size_bytes > %s"
        row = connection.execute(query, [SIDE_PX * SIDE_PX]).fetchone()
    return int(row[0]) if row else 0


def main() -> int:
    """Run them all once."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--slots", type=int, default=4, help="jobs at once")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="octasplat-chaos-") as name:
        root = Path(name)
        root.chmod(0o711)
        machine = Machine(root / "d", options.slots)
        machine.start()
        try:
            run = Run(machine, make_scene(root / "scene"), random.Random(0), {})
            those = upheave(run, root)
            print(json.dumps({**report(those), "faults": those.faults}, indent=1))
        finally:
            machine.stop()
    return 1 if those.faults else 0


if __name__ == "__main__":
    raise SystemExit(main())
