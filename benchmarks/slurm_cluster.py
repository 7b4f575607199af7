"""``python -m benchmarks.slurm_cluster -- COMMAND``: runs a command beside a Slurm cluster on this
machine, to try ``profiles/slurm``: a controller and nodes of one CPU each on the loopback address.

Needs root, and Debian's packages ``slurm-wlm`` and ``munge``. The cluster has no accounting.
"""

from __future__ import annotations

import argparse
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

PROGRAMS = ("munged", "slurmctld", "slurmd", "sbatch", "squeue", "scontrol")

# Where Slurm's programs look for their configuration, also in jobs, to which the executor plugin
# passes no variables of Slurm.
CONF = Path("/etc/slurm/slurm.conf")
MARK = "# of benchmarks.slurm_cluster\n"
_CONF = """
ClusterName=test
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={port}
CommunicationParameters=NoCtldInAddrAny,NoInAddrAny
AuthType=auth/munge
AuthInfo=socket={folder}/munge/socket,cred_expire=20
CryptoType=crypto/munge
SlurmUser=root
SlurmdUser=root
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool/%n
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/%n.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/%n.log
SlurmdParameters=config_overrides
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
JobAcctGatherType=jobacct_gather/linux
JobAcctGatherFrequency=2
JobAcctGatherParams=OverMemoryKill
AccountingStorageType=accounting_storage/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core_Memory
KillWait=10
MinJobAge=3600
SlurmdTimeout=10
ReturnToService=2
MpiDefault=none
{nodes}
PartitionName=all Nodes={names} Default=YES MaxTime=INFINITE State=UP
"""


@dataclass(frozen=True)
class Cluster:
    """A running cluster.

    Attributes:
        folder: The folder of its configuration, state and logs.
        environment: The variables with which Slurm's commands find it.
        controllers: The supervisor of the running controller.
    """

    folder: Path
    environment: dict[str, str]
    controllers: list[subprocess.Popen[bytes]] = field(default_factory=list)

    def run(self, *command: str, check: bool = True) -> str:
        """Run a program of Slurm and return what it prints; with ``check``, repeat it for up to a
        minute until it succeeds, because the controller may still be starting."""
        end = time.monotonic() + 60
        while True:
            done = subprocess.run(
                command, env=self.environment, capture_output=True, text=True, timeout=120
            )
            if not check or done.returncode == 0:
                return done.stdout
            if time.monotonic() > end:
                raise RuntimeError(f"{' '.join(command)}: {done.stderr}")
            time.sleep(0.5)

    def jobs(self) -> dict[str, str]:
        """Id -> state of the jobs that are pending or running."""
        lines = self.run("squeue", "-h", "-o", "%i %T").splitlines()
        return dict(line.split(maxsplit=1) for line in lines)

    def start_controller(self) -> None:
        """Start the controller, and again if it crashes, as a service manager does: that of Slurm
        22.05 does if the job of a lost node is started earlier than Slurm would (``cred_expire``),
        and asks for its nodes."""
        stopped = self.folder / "stopped"
        stopped.unlink(missing_ok=True)
        loop = f"while [ -d {self.folder} -a ! -e {stopped} ]; do slurmctld -D; sleep 1; done"
        command = ["sh", "-c", loop]
        self.controllers.append(
            subprocess.Popen(
                command, env=self.environment, stderr=subprocess.DEVNULL, cwd=self.folder
            )
        )

    def stop_controller(self) -> None:
        (self.folder / "stopped").touch()
        while self.controllers:
            # A controller that has just been started has not written its file yet.
            _stop(self.folder / "slurmctld.pid")
            try:
                self.controllers[-1].wait(2)
                self.controllers.pop()
            except subprocess.TimeoutExpired:
                continue

    def start_node(self, name: str) -> None:
        subprocess.run(["slurmd", "-N", name], env=self.environment, check=True)

    def stop_node(self, name: str) -> None:
        _stop(self.folder / f"{name}.pid")

    def wait_until_idle(self, seconds: float = 60) -> None:
        """Wait until all nodes can run jobs."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            states = self.run("sinfo", "-h", "-N", "-o", "%T", check=False).split()
            if states and all(state == "idle" for state in states):
                return
            time.sleep(0.5)
        raise RuntimeError(f"the nodes are {states}; see {self.folder}")


def missing_programs() -> list[str]:
    """What is missing to start a cluster, such as programs or the rights of root."""
    missing = [name for name in PROGRAMS if shutil.which(name, path=_path()) is None]
    if CONF.exists() and not CONF.read_text().startswith(MARK):
        missing.append(f"a machine without {CONF}")
    return missing + ([] if os.geteuid() == 0 else ["root"])


@contextmanager
def running(folder: Path, nodes: int = 2, memory_mb: int = 6000) -> Iterator[Cluster]:
    """A cluster that ends with the block.

    Args:
        folder: An absolute path; short, because sockets are in it.
        memory_mb: The memory of each node.
    """
    for name in ("munge", "state", "spool"):
        (folder / name).mkdir(parents=True)
    names = [f"n{i}" for i in range(nodes)]
    ports = [_free_port() for _ in range(nodes + 1)]
    lines = [
        f"NodeName={name} NodeHostname={socket.gethostname()} NodeAddr=127.0.0.1 Port={port}"
        f" CPUs=1 RealMemory={memory_mb} State=UNKNOWN"
        for name, port in zip(names, ports[1:], strict=True)
    ]
    text = _CONF.format(
        folder=folder,
        host=socket.gethostname(),
        port=ports[0],
        nodes="\n".join(lines),
        names=",".join(names),
    )
    CONF.parent.mkdir(exist_ok=True)
    CONF.write_text(MARK + text)
    environment = os.environ | {"PATH": _path()}
    cluster = Cluster(folder, environment)
    munge = _start_munge(folder / "munge")
    try:
        cluster.start_controller()
        for name in names:
            cluster.start_node(name)
        cluster.wait_until_idle()
        yield cluster
    finally:
        cluster.run("scancel", "--full", "--state=running", "--user=root", check=False)
        for name in names:
            cluster.stop_node(name)
        cluster.stop_controller()
        munge.terminate()
        munge.wait(10)
        CONF.unlink()


def _start_munge(folder: Path) -> subprocess.Popen[bytes]:
    key = folder / "key"
    key.write_bytes(os.urandom(64))
    key.chmod(0o400)
    # The socket must be reachable, the rest private.
    folder.chmod(0o711)
    files = {"key-file": "key", "log-file": "log", "pid-file": "pid", "seed-file": "seed"}
    options = [f"--{option}={folder / name}" for option, name in files.items()]
    process = subprocess.Popen(
        ["munged", "--foreground", "--force", f"--socket={folder / 'socket'}", *options],
        env=os.environ | {"PATH": _path()},
        stderr=subprocess.DEVNULL,
    )
    end = time.monotonic() + 20
    while not (folder / "socket").exists():
        if time.monotonic() > end or process.poll() is not None:
            raise RuntimeError(f"munged has not started; see {folder / 'log'}")
        time.sleep(0.1)
    return process


def _stop(pid_file: Path) -> None:
    """Terminate a daemon and wait until it has ended."""
    try:
        pid = int(pid_file.read_text())
        os.kill(pid, 15)
    except (OSError, ValueError):
        return
    for _ in range(100):
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return
        time.sleep(0.1)
    os.kill(pid, 9)


def _free_port() -> int:
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return int(found.getsockname()[1])


def _path() -> str:
    return os.pathsep.join([os.environ.get("PATH", ""), "/usr/sbin", "/sbin"])


def main() -> int:
    parser = argparse.ArgumentParser("benchmarks.slurm_cluster", description=__doc__)
    parser.add_argument("--nodes", type=int, default=2)
    parser.add_argument("--memory-mb", type=int, default=6000, help="of each node")
    parser.add_argument("command", nargs="+")
    options = parser.parse_args()
    if missing := missing_programs():
        parser.error(f"missing: {', '.join(missing)}")
    # Sockets are in this folder, and their paths must be short.
    folder = Path(tempfile.mkdtemp(prefix="slurm-"))
    try:
        with running(folder, options.nodes, options.memory_mb) as cluster:
            done = subprocess.run(options.command, env=cluster.environment, check=False)
            print(cluster.run("squeue", "-t", "all", "-o", "%i %T %M %C %m %l %N"))
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    return done.returncode


if __name__ == "__main__":
    sys.exit(main())
