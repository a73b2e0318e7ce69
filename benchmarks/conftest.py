"""What pytest-benchmark saves: statistics and the machine's description, nothing that names it."""

from benchmarks.common import machine


def pytest_benchmark_generate_machine_info(config):
    return machine()


def pytest_benchmark_generate_commit_info(config):
    return {}


def pytest_benchmark_update_json(config, benchmarks, output_json):
    for part in output_json["benchmarks"]:
        part["stats"].pop("data", None)
