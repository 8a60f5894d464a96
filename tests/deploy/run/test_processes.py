"""Test where the processes of a run serve their metrics."""

import pytest

from brakeline.deploy.run.processes import client_settings, metrics_address, write_endpoint
from brakeline.messaging.bus import BusSettings


@pytest.mark.parametrize(
    ("launcher", "third"), [("9100", "9103"), ("0.0.0.0:9100", "0.0.0.0:9103"), ("", "")], ids=["here", "there", "none"]
)
def test_processes_have_the_ports_after_that_of_their_launcher(launcher, third, tmp_path):
    write_endpoint(tmp_path, BusSettings(listen=("tcp/127.0.0.1:7447",), metrics=launcher))
    assert metrics_address(tmp_path, 2) == third
    assert client_settings(tmp_path).metrics == "", "who looks on does not take a port"
