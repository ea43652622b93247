"""A sweep on a Dask cluster over TLS with certificates of one's own, as docs/reference/security.md describes it."""

import os
import shutil
import socket
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from small_work import SWEEP, content

from pachon.core.dask_cluster import dask_client
from pachon.core.errors import ConfigError

pytest.importorskip("distributed")


def certificates(folder, name):
    """Make an authority, and a certificate of it for this machine."""
    folder.mkdir()

    def openssl(*words):
        subprocess.run(["openssl", *words], cwd=folder, check=True, capture_output=True)

    key = ["-newkey", "rsa:2048", "-nodes"]
    openssl("req", "-x509", *key, "-keyout", "ca-key.pem", "-out", "ca.pem", "-days", "2", "-subj", f"/CN={name}")
    openssl("req", *key, "-keyout", "key.pem", "-out", "request.pem", "-subj", "/CN=localhost")
    (folder / "names").write_text("subjectAltName=DNS:localhost,IP:127.0.0.1\n")
    openssl(
        "x509", "-req", "-in", "request.pem", "-CA", "ca.pem", "-CAkey", "ca-key.pem", "-CAcreateserial",
        "-out", "cert.pem", "-days", "2", "-extfile", "names",
    )  # fmt: skip
    pair = {"cert": str(folder / "cert.pem"), "key": str(folder / "key.pem")}
    tls = {"ca-file": str(folder / "ca.pem"), "scheduler": pair, "worker": pair, "client": pair}
    (folder / "config").mkdir()
    settings = {"distributed": {"comm": {"require-encryption": True, "tls": tls}}}
    (folder / "config" / "tls.yaml").write_text(yaml.safe_dump(settings))
    return {**os.environ, "DASK_CONFIG": str(folder / "config"), "PYTHONPATH": os.getcwd()}


@pytest.fixture
def tls_cluster(tmp_path):
    """Address of a scheduler with two workers over TLS, and the environment of those it trusts."""
    environment = certificates(tmp_path / "ours", "ours")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    address = f"tls://127.0.0.1:{port}"
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "env": environment}
    scheduler = ["dask_scheduler", "--protocol", "tls", "--host", "127.0.0.1", "--port", str(port), "--no-dashboard"]
    worker = ["dask_worker", address, "--nthreads", "1", "--no-dashboard", "--no-nanny"]
    started = [
        subprocess.Popen([sys.executable, "-m", f"distributed.cli.{words[0]}", *words[1:]], **quiet)
        for words in (scheduler, worker, worker)
    ]
    yield address, environment
    for process in started:
        process.kill()
        process.wait()


def sweep(folder, environment, *options):
    """Run the command; return the finished process."""
    folder.mkdir()
    command = [sys.executable, "-m", "pachon", "sweep", str(folder.parent / "sweep.yaml"), "--quiet", *options]
    return subprocess.run([*command, "-o", "s.sweep"], cwd=folder, env=environment, capture_output=True, text=True,
                          check=False)  # fmt: skip


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("openssl") is None, reason="needs openssl")
def test_a_sweep_over_tls_has_the_figures_of_this_process(tls_cluster, tmp_path):
    address, environment = tls_cluster
    (tmp_path / "sweep.yaml").write_text(yaml.safe_dump(SWEEP))
    done = sweep(tmp_path / "tls", environment, "--scheduler", address)
    assert (done.returncode, done.stderr) == (0, "")
    assert sweep(tmp_path / "alone", environment, "--processes", "1").returncode == 0
    assert content(tmp_path / "tls")["s.sweep"] == content(tmp_path / "alone")["s.sweep"]
    strangers = {
        "without certificates": (address, {**environment, "DASK_CONFIG": str(tmp_path / "none")}),
        "of another authority": (address, certificates(tmp_path / "theirs", "theirs")),
        "without TLS": (address.replace("tls", "tcp"), {**environment, "DASK_CONFIG": str(tmp_path / "none")}),
    }
    for name, (place, theirs) in strangers.items():
        refused = sweep(tmp_path / name, theirs, "--scheduler", place)
        lines = refused.stderr.splitlines()
        print(name, lines)
        assert refused.returncode == 2
        assert len(lines) == 1
        assert lines[0].startswith("pachon: error: --scheduler")
        assert not list(Path(tmp_path / name).iterdir())


@pytest.mark.parametrize(
    ("address", "options", "said"),
    [
        ("tls://127.0.0.1:9", {}, "expected distributed.comm.tls in Dask's configuration: ca-file"),
        ("tcp://127.0.0.1:9", {"require_encryption": True}, "requires encryption; expected an address with tls://"),
        ("tls://127.0.0.1:9", {"tls_ca_file": "none.pem", "tls_client_cert": "none.pem", "tls_client_key": "none.pem"},
         "the certificates of distributed.comm.tls cannot be used"),
    ],
)  # fmt: skip
def test_certificates_that_do_not_fit_the_address(address, options, said):
    from distributed import Security

    with pytest.raises(ConfigError, match=said), dask_client(address, Security(**options)):
        pass
