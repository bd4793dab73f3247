"""A Dask cluster with certificates: only who has one runs anything, and the results are the same."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from ekfslam.cli import main
from ekfslam.errors import ConfigError
from ekfslam.studies.executors import open_executor

distributed = pytest.importorskip("distributed", reason="distributed is not installed: pip install ekfslam[cluster]")
dask = pytest.importorskip("dask")


def openssl(*arguments: str) -> None:
    if shutil.which("openssl") is None:
        pytest.skip("openssl, which makes the certificates of this test, is not installed")
    subprocess.run(["openssl", *arguments], check=True, capture_output=True)


@pytest.fixture(scope="module")
def certificates(tmp_path_factory) -> dict[str, str]:
    """Settings of Dask: an authority of our own, and a certificate that it has signed."""
    folder = tmp_path_factory.mktemp("tls")
    ca, ca_key, cert, key, request = (
        str(folder / name) for name in ("ca.pem", "ca-key.pem", "cert.pem", "key.pem", "r.csr")
    )
    openssl(
        "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-keyout", ca_key, "-out", ca, "-subj", "/CN=ca", "-days", "2"
    )
    openssl("req", "-newkey", "rsa:2048", "-nodes", "-keyout", key, "-out", request, "-subj", "/CN=localhost")
    openssl("x509", "-req", "-in", request, "-CA", ca, "-CAkey", ca_key, "-CAcreateserial", "-out", cert, "-days", "2")
    both = str(Path(folder) / "both.pem")
    Path(both).write_text(Path(cert).read_text() + Path(key).read_text())
    roles = {f"distributed.comm.tls.{role}.cert": both for role in ("client", "scheduler", "worker")}
    return {"distributed.comm.tls.ca-file": ca, **roles}


@pytest.fixture
def cluster(certificates):
    with dask.config.set(certificates):
        security = distributed.Security(require_encryption=True)
        with distributed.LocalCluster(
            n_workers=1,
            threads_per_worker=1,
            processes=False,
            protocol="tls",
            security=security,
            dashboard_address=None,
            host="127.0.0.1",
        ) as opened:
            yield opened


@pytest.mark.slow
def test_work_is_done_over_tls(cluster, certificates):
    assert cluster.scheduler_address.startswith("tls://")
    with dask.config.set(certificates), open_executor(cluster.scheduler_address) as executor:
        assert executor.submit(pow, 2, 10).result(timeout=30) == 1024


def test_who_has_no_certificate_does_nothing(cluster, certificates):
    address = cluster.scheduler_address
    nothing = dict.fromkeys(certificates)
    with dask.config.set(nothing):
        with pytest.raises(ConfigError, match="no certificates"), open_executor(address):
            pass
        plain = address.replace("tls://", "dask://")
        short = dask.config.set({"distributed.comm.timeouts.connect": "1s"})
        with short, pytest.raises(ConfigError, match="no scheduler there"), open_executor(plain):
            pass


def test_a_certificate_that_is_none_is_a_named_error(cluster, certificates, tmp_path):
    (tmp_path / "no.pem").write_text("no certificate")
    wrong = {**certificates, "distributed.comm.tls.client.cert": str(tmp_path / "no.pem")}
    with dask.config.set(wrong), pytest.raises(ConfigError), open_executor(cluster.scheduler_address):
        pass


def test_the_help_says_the_risk(capsys):
    with pytest.raises(SystemExit):
        main(["consistency", "--help"])
    helped = " ".join(capsys.readouterr().out.split())
    assert "tls://HOST:PORT" in helped
    assert "anyone who reaches that port runs programs as you" in helped
