"""Metrics in the format of Prometheus: what the tables say now, and what this process has counted."""

from collections.abc import Iterable, Iterator, Mapping

from prometheus_client import CollectorRegistry, Counter, PlatformCollector, ProcessCollector, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from octasplat.workers.queue.numbers import Numbers

_TOTALS = {
    "attempts": "Starts of jobs.",
    "rescues": "Jobs taken from workers that were lost.",
    "poisoned": "Jobs failed because they lost their worker again and again.",
}
_ENDS = ("succeeded", "failed", "canceled")


class Metrics:
    """Counters of this process."""

    def __init__(self) -> None:
        self._registry = CollectorRegistry()
        ProcessCollector(registry=self._registry)
        PlatformCollector(registry=self._registry)
        self.upload_bytes = Counter(
            "octasplat_upload_bytes", "Bytes of uploads taken by this front end.", registry=self._registry
        )

    def render(self, numbers: Numbers, *, streams: int, free_bytes: int | None) -> bytes:
        """Everything, as text.

        Args:
            numbers: what the tables say.
            streams: streams of events that this front end serves.
            free_bytes: room above the floor in the store; None where it has no known end.
        """
        gauges = {"octasplat_event_streams": ("Streams of events of this front end.", float(streams))}
        if free_bytes is not None:
            gauges["octasplat_storage_free_bytes"] = (
                "Room in the store above the floor; negative below it.", float(free_bytes)
            )  # fmt: skip
        now = CollectorRegistry()
        now.register(_Fixed([*_of_tables(numbers), *(GaugeMetricFamily(n, *g) for n, g in gauges.items())]))
        return generate_latest(self._registry) + generate_latest(now)


class _Fixed(Collector):
    """Metrics that are known already."""

    def __init__(self, metrics: Iterable[Metric]) -> None:
        self._metrics = list(metrics)

    def collect(self) -> Iterator[Metric]:
        """They."""
        yield from self._metrics


def _of_tables(numbers: Numbers) -> Iterator[Metric]:
    queues = sorted({"cpu", *(d.queue for d in numbers.depths), *numbers.running, *numbers.slots})
    waiting = {depth.queue: float(depth.waiting) for depth in numbers.depths}
    oldest = {depth.queue: depth.oldest_seconds for depth in numbers.depths}
    by_queue: dict[str, tuple[str, Mapping[str, float]]] = {
        "octasplat_queue_depth": ("Jobs that wait.", waiting),
        "octasplat_queue_oldest_seconds": ("For how long the job that waits longest has.", oldest),
        "octasplat_jobs_running": ("Jobs that run.", numbers.running),
        "octasplat_worker_slots": ("Jobs that the living workers may run at once.", numbers.slots),
    }
    for name, (meaning, values) in by_queue.items():
        gauge = GaugeMetricFamily(name, meaning, labels=["queue"])
        for queue in queues:
            gauge.add_metric([queue], values.get(queue, 0))
        yield gauge
    yield GaugeMetricFamily("octasplat_workers", "Workers that live.", numbers.workers)
    ages = {
        "octasplat_worker_heartbeat_age_seconds": (
            "Since the living worker that was quiet for longest was heard of.", numbers.worker_age_seconds
        ),
        "octasplat_job_heartbeat_age_seconds": (
            "Since the running job that was quiet for longest was heard of.", numbers.heartbeat_age_seconds
        ),
    }  # fmt: skip
    for name, (meaning, age) in ages.items():
        if age is not None:
            yield GaugeMetricFamily(name, meaning, max(0.0, age))
    for total, meaning in _TOTALS.items():
        yield CounterMetricFamily(f"octasplat_job_{total}", meaning, numbers.totals[total])
    ended = CounterMetricFamily("octasplat_jobs_finished", "Jobs that came to an end.", labels=["state"])
    for state in _ENDS:
        ended.add_metric([state], numbers.totals[state])
    yield ended
    messages = GaugeMetricFamily("octasplat_webhook_messages", "Messages not delivered.", labels=["state"])
    for state, count in sorted(numbers.webhooks.items()):
        messages.add_metric([state], count)
    yield messages
