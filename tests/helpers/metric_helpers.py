"""Values of metrics for comparisons."""


def values(metrics):
    """Return the values of `MetricValue`s by key."""
    return {key: metric.value for key, metric in metrics.items()}
