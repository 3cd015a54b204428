"""How an evaluation was made, in words: for reports and the pages of methods."""

from __future__ import annotations

from hwp_bench.results import Results


def provenance(result: Results) -> dict[str, str]:
    """Say what the numbers of an evaluation depend on, in words, by heading."""
    environment = result.environment
    packages = environment.get("packages", {})
    devices = sorted({capture.device for capture in result.captures if capture.device})
    limits = [f"{value:g} {name}" for name, value in result.budget.items() if value]
    return {
        "Method": f"{result.method.title} ({result.method.name}), preset {result.method.preset}",
        "Settings": ", ".join(f"{k} = {v}" for k, v in result.method.settings.items()) or "none",
        "Suite, frames, seed": f"{result.suite}, {result.frames}, {result.seed}",
        "Budget": ", ".join(limits) or "none",
        "Started": result.started,
        "Device": ", ".join(devices) or "not said",
        "System": f"{environment.get('system', '?')}, {environment.get('processor', '?')}, "
        f"{environment.get('cores', '?')} cores, Python {environment.get('python', '?')}",
        "Packages": ", ".join(f"{k} {v}" for k, v in packages.items())
        if isinstance(packages, dict)
        else "?",
        "Toolkit": result.toolkit,
        "Method digest": result.method.digest,
    }
