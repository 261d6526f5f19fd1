"""Prometheus metrics: figures of the tables, and counters of this process."""

from collections.abc import Iterable, Iterator, Mapping

from prometheus_client import CollectorRegistry, Counter, PlatformCollector, ProcessCollector, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from octasplat.workers.queue.service_stats import ServiceStats

_TOTALS = {
    "attempts": "Starts of jobs.",
    "rescues": "Jobs taken from workers that were lost.",
    "poisoned": "Jobs failed because they lost their worker again and again.",
}
_TERMINAL_STATES = ("succeeded", "failed", "canceled")


class Metrics:
    """Counters of this process."""

    def __init__(self) -> None:
        self._registry = CollectorRegistry()
        ProcessCollector(registry=self._registry)
        PlatformCollector(registry=self._registry)
        self.upload_bytes = Counter(
            "octasplat_upload_bytes", "Bytes of uploads taken by this front end.", registry=self._registry
        )

    def render(self, stats: ServiceStats, *, streams: int, free_bytes: int | None) -> bytes:
        """Return all metrics as text.

        Args:
            stats: what the tables say.
            streams: streams of events that this front end serves.
            free_bytes: room above the floor in the store; None where it has no known end.
        """
        gauges = {"octasplat_event_streams": ("Streams of events of this front end.", float(streams))}
        if free_bytes is not None:
            gauges["octasplat_storage_free_bytes"] = (
                "Room in the store above the floor; negative below it.", float(free_bytes)
            )  # fmt: skip
        # Counters of the process are kept; the figures of the tables are made anew for each request.
        now = CollectorRegistry()
        now.register(
            _FixedCollector([*_table_metrics(stats), *(GaugeMetricFamily(n, *g) for n, g in gauges.items())])
        )
        return generate_latest(self._registry) + generate_latest(now)


class _FixedCollector(Collector):
    """Collector of metrics that were computed beforehand."""

    def __init__(self, metrics: Iterable[Metric]) -> None:
        self._metrics = list(metrics)

    def collect(self) -> Iterator[Metric]:
        """Yield the metrics that were given."""
        yield from self._metrics


def _table_metrics(stats: ServiceStats) -> Iterator[Metric]:
    queues = sorted({"cpu", *(d.queue for d in stats.depths), *stats.running, *stats.slots})
    waiting = {depth.queue: float(depth.waiting) for depth in stats.depths}
    oldest = {depth.queue: depth.oldest_seconds for depth in stats.depths}
    by_queue: dict[str, tuple[str, Mapping[str, float]]] = {
        "octasplat_queue_depth": ("Jobs that wait.", waiting),
        "octasplat_queue_oldest_seconds": ("For how long the job that waits longest has.", oldest),
        "octasplat_jobs_running": ("Jobs that run.", stats.running),
        "octasplat_worker_slots": ("Jobs that the living workers may run at once.", stats.slots),
    }
    for name, (meaning, values) in by_queue.items():
        gauge = GaugeMetricFamily(name, meaning, labels=["queue"])
        for queue in queues:
            gauge.add_metric([queue], values.get(queue, 0))
        yield gauge
    yield GaugeMetricFamily("octasplat_workers", "Workers that live.", stats.workers)
    ages = {
        "octasplat_worker_heartbeat_age_seconds": (
            "Since the living worker that was quiet for longest was heard of.", stats.worker_age_seconds
        ),
        "octasplat_job_heartbeat_age_seconds": (
            "Since the running job that was quiet for longest was heard of.", stats.heartbeat_age_seconds
        ),
    }  # fmt: skip
    for name, (meaning, age) in ages.items():
        if age is not None:
            yield GaugeMetricFamily(name, meaning, max(0.0, age))
    for total, meaning in _TOTALS.items():
        yield CounterMetricFamily(f"octasplat_job_{total}", meaning, stats.totals[total])
    ended = CounterMetricFamily("octasplat_jobs_finished", "Jobs that came to an end.", labels=["state"])
    for state in _TERMINAL_STATES:
        ended.add_metric([state], stats.totals[state])
    yield ended
    messages = GaugeMetricFamily("octasplat_webhook_messages", "Messages not delivered.", labels=["state"])
    for state, count in sorted(stats.webhooks.items()):
        messages.add_metric([state], count)
    yield messages
