"""Values of metrics for comparisons."""

import json

from jumper_warp.utils.metrics import MetricValue


def values(metrics):
    """Return the values of `MetricValue`s by key."""
    return {key: metric.value for key, metric in metrics.items()}


def saved_metrics(folder):
    """Return the metrics in a folder's metrics.json by key, as MetricValue."""
    entries = json.loads((folder / "metrics.json").read_text())["metrics"]
    return {key: MetricValue(*(entry[name] for name in MetricValue._fields)) for key, entry in entries.items()}
