"""The dashboard, the alert rules and the manifests name only what exists, and their own validators take them."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from typing import Any

import compose_spec
import kubernetes_validate
import promql_parser
import pytest
import yaml
from prometheus_client import generate_latest
from prometheus_client.parser import text_string_to_metric_families
from typer.main import get_command

from contract import ROOT
from mapvote.cli import app
from mapvote.config import Settings
from mapvote_server.api.services import Metrics

MONITORING = ROOT / "packaging/monitoring"
DASHBOARD = json.loads((MONITORING / "grafana-dashboard.json").read_text())
ALERTS = yaml.safe_load((MONITORING / "alerts.yaml").read_text())
MANIFESTS = list(yaml.safe_load_all((ROOT / "packaging/kubernetes/mapvote.yaml").read_text()))
RULES = [rule for group in ALERTS["groups"] for rule in group["rules"]]


def shown() -> list[str]:
    """The expressions of the dashboard, with its variables as Grafana would fill them in."""
    queries = [target["expr"] for panel in DASHBOARD["panels"] for target in panel["targets"]]
    return [query.replace("$job", "mapvote").replace("$__rate_interval", "1m") for query in queries]


def selectors(node: Any) -> list[tuple[str, set[str]]]:
    """(name, labels that are matched) of every series that an expression reads."""
    if isinstance(node, promql_parser.VectorSelector):
        return [(str(node.name), {matcher.name for matcher in node.matchers.matchers})]
    inner = [getattr(node, name, None) for name in ("expr", "lhs", "rhs", "vector_selector")]
    inner += list(getattr(node, "args", None) or [])
    return [found for one in inner if one is not None for found in selectors(one)]


def exported() -> dict[str, set[str]]:
    """Names of the series of /metrics with their labels, once each was used."""
    metrics = Metrics()
    metrics.requests.labels("GET", 200).inc()
    metrics.ballots.labels("created").inc()
    metrics.seconds.labels("GET").observe(0.1)
    metrics.tell_damaged([])
    families = text_string_to_metric_families(generate_latest(metrics.registry).decode())
    found: dict[str, set[str]] = {}
    for sample in (sample for family in families for sample in family.samples):
        found.setdefault(sample.name, set()).update(sample.labels)
    return found


@pytest.mark.parametrize("expression", [*shown(), *(rule["expr"] for rule in RULES)])
def test_every_expression_reads_series_and_labels_that_the_server_exports(expression: str) -> None:
    series = exported() | {"up": set()}
    read = selectors(promql_parser.parse(expression))
    assert read
    for name, labels in read:
        assert name in series
        assert labels <= series[name] | {"job", "instance"}, "Prometheus adds these two"


def test_a_series_that_no_server_exports_is_found() -> None:
    """The check above can fail."""
    read = selectors(promql_parser.parse('sum by (a) (rate(mapvote_votes_total{kind="x"}[5m])) / max(up) > 0'))
    assert read == [("mapvote_votes_total", {"kind"}), ("up", set())]
    assert "mapvote_votes_total" not in exported()
    with pytest.raises(ValueError, match="unclosed left parenthesis"):
        promql_parser.parse("sum(rate(mapvote_requests_total[5m])")


def test_every_panel_has_a_place_of_its_own_and_the_alerts_say_what_mends() -> None:
    places = [tuple(panel["gridPos"].values()) for panel in DASHBOARD["panels"]]
    squares = [(x + i, y + j) for x, y, w, h in places for i in range(w) for j in range(h)]
    assert len(set(squares)) == len(squares)
    assert all(0 <= x < 24 for x, _ in squares)
    assert len({panel["id"] for panel in DASHBOARD["panels"]}) == len(places)
    assert all({"summary", "mend"} == rule["annotations"].keys() for rule in RULES)


def test_promtool_takes_the_rules() -> None:
    promtool = shutil.which("promtool")
    if promtool is None:
        pytest.skip("promtool is not installed: apt-get install prometheus")
    done = subprocess.run([promtool, "check", "rules", str(MONITORING / "alerts.yaml")], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("manifest", MANIFESTS, ids=lambda one: one["kind"])
def test_kubernetes_takes_the_manifests(manifest: dict[str, Any]) -> None:
    kubernetes_validate.validate(manifest, "1.33", strict=True)
    with pytest.raises(kubernetes_validate.ValidationError):
        kubernetes_validate.validate({**manifest, "metadata": {"name": 7}}, "1.33", strict=True)


def test_the_pod_starts_the_server_with_options_and_settings_that_exist_and_asks_its_probes() -> None:
    (deployment,) = [one for one in MANIFESTS if one["kind"] == "Deployment"]
    (container,) = deployment["spec"]["template"]["spec"]["containers"]
    options = get_command(app).commands["serve"].params  # type: ignore[attr-defined]
    assert {word for word in container["args"] if word.startswith("--")} <= {o for p in options for o in p.opts}
    assert container["livenessProbe"]["httpGet"]["path"] == "/livez"
    assert container["readinessProbe"]["httpGet"]["path"] == "/readyz"
    (config,) = [one for one in MANIFESTS if one["kind"] == "ConfigMap"]
    named = set(re.findall(r"^(\w+) =", config["data"]["mapvote.toml"], re.MULTILINE))
    assert named <= set(type(Settings().server).model_fields)


def test_compose_takes_its_file() -> None:
    text = (ROOT / "examples/compose.yaml").read_text()
    made = compose_spec.PyCompose.from_yaml(text)
    made.validate()
    assert sorted(made.service_names()) == ["database", "mapvote"]
    with pytest.raises(ValueError, match="prots"):
        compose_spec.PyCompose.from_yaml(text.replace("ports:", "prots:"))
