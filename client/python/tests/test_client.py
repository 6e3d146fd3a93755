"""The client against a real daemon: `cargo build --bins && python3 client/python/tests/test_client.py`.

PBGI_BIN names the folder of the programs; target/debug and target/release are looked at otherwise.
"""

import os
import pathlib
import shutil
import socket
import subprocess
import sys
import tempfile
import threading
import time
import unittest

HERE = pathlib.Path(__file__).resolve().parent
ROOT = HERE.parent.parent.parent
sys.path.insert(0, str(HERE.parent))

try:
    import numpy as np

    import pbgi
except ImportError as error:
    print(f"SKIPPED: {error}; pip install grpcio protobuf numpy")
    sys.exit(0)


def programs() -> pathlib.Path:
    target = pathlib.Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target"))
    for folder in [os.environ.get("PBGI_BIN"), target / "debug", target / "release"]:
        if folder and (pathlib.Path(folder) / "pbgi-server").exists():
            return pathlib.Path(folder)
    print("SKIPPED: no pbgi-server; cargo build --bins first")
    sys.exit(0)


BIN = programs()


class Daemon:
    def __init__(self, config: str = ""):
        self.folder = pathlib.Path(tempfile.mkdtemp(prefix="pbgi-py-"))
        (self.folder / "server.toml").write_text(config.replace("FOLDER", str(self.folder)))
        command = [BIN / "pbgi-server", "--memory", "256M", "--workers", "2", "--config", self.folder / "server.toml"]
        for name in ["runtime", "state", "scratch"]:
            command += [f"--{name}-dir", self.folder / name]
        (self.folder / "in").mkdir()
        log = open(self.folder / "log", "w")
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=log)
        log.close()
        line = self.process.stdout.readline().decode().strip()
        assert line == "READY", line + (self.folder / "log").read_text()

    def make_scene(self) -> None:
        """A floor of points with a bright disc above it, as PLY."""
        points = [f"{x} 0 {y} 0 1 0 0.08 0.5 0.5 0.5" for x in range(-20, 21) for y in range(-20, 21)]
        points += [f"{x / 10} 3 {y / 10} 0 -1 0 0.08 9 5 1" for x in range(-10, 11) for y in range(-10, 11)]
        names = "x y z nx ny nz radius red green blue".split()
        header = ["ply", "format ascii 1.0", f"element vertex {len(points)}"] + [f"property float {n}" for n in names]
        (self.folder / "in/scene.ply").write_text("\n".join(header + ["end_header"] + points) + "\n")

    def stop(self) -> None:
        self.process.terminate()
        assert self.process.wait(60) == 0, (self.folder / "log").read_text()
        self.process.stdout.close()
        shutil.rmtree(self.folder)


def shade(test: unittest.TestCase, client: "pbgi.Client", source: str, scene: str) -> None:
    client.submit_build("build", [source], scene, labels={"show": "dune"}, priority=3)
    statistics = client.wait("build")
    test.assertEqual(statistics["points"], 41 * 41 + 21 * 21)
    test.assertEqual(client.scene(scene).point_count, 41 * 41 + 21 * 21)
    positions = np.zeros((3000, 3), np.float32)
    positions[:, 0] = np.linspace(-1, 1, 3000)
    positions[:, 1] = 0.5
    normals = np.tile(np.float32([0, 1, 0]), (3000, 1))
    normals[7] = 0
    shaded = client.shade_points(scene, positions, normals)
    test.assertEqual(shaded.irradiance.shape, (3000, 3))
    test.assertTrue(np.all(shaded.irradiance[7] == 0) and np.all(shaded.irradiance[8] > 0))
    red, green, blue = shaded.irradiance[1500]
    test.assertTrue(red > green > blue > 0, (red, green, blue))
    test.assertTrue(0.0 < shaded.occlusion[1500] < 0.9)
    test.assertAlmostEqual(float(np.linalg.norm(shaded.bent_normal[1500])), 1.0, places=3)
    # Symmetric scene, symmetric light; and the same answer in blocks.
    np.testing.assert_allclose(shaded.irradiance[100], shaded.irradiance[2899], rtol=0.1)
    blocks = [(positions[i : i + 1024], normals[i : i + 1024]) for i in range(0, 3000, 1024)]
    streamed = np.concatenate([part.irradiance for part in client.shade_stream(scene, blocks)])
    np.testing.assert_array_equal(streamed, shaded.irradiance)


class UnixSocket(unittest.TestCase):
    def setUp(self):
        self.daemon = Daemon()
        self.client = pbgi.Client(str(self.daemon.folder / "runtime/jobs.sock"))

    def tearDown(self):
        self.client.close()
        self.daemon.stop()

    def test_scene_is_built_and_points_are_shaded(self):
        self.daemon.make_scene()
        folder = self.daemon.folder
        shade(self, self.client, str(folder / "in/scene.ply"), str(folder / "scene.pbgi"))
        job = self.client.jobs()[0]
        self.assertEqual((job.options.labels["show"], job.options.priority), ("dune", 3))
        self.assertEqual(job.history[-1].text, "succeeded")
        self.assertEqual(self.client.status().version, "0.1.0")
        pages, size = self.client.warm_scene(str(folder / "scene.pbgi"))
        self.assertTrue(pages >= 2 and size > 0)
        # A small request on a warm scene, end to end.
        one = np.float32([[0, 0.5, 0]]), np.float32([[0, 1, 0]])
        times = []
        for _ in range(50):
            begun = time.perf_counter()
            self.client.shade_points(str(folder / "scene.pbgi"), *one)
            times.append(time.perf_counter() - begun)
        print(f"a new stream with one receiver: median {sorted(times)[25] * 1e3:.1f} ms")
        # The same within one stream: the next receiver goes out when the last is answered.
        times = []

        def receivers():
            for _ in range(200):
                times.append(time.perf_counter())
                yield one
                answered.acquire()

        answered = threading.Semaphore(0)
        latencies = []
        for _ in self.client.shade_stream(str(folder / "scene.pbgi"), receivers()):
            latencies.append(time.perf_counter() - times[-1])
            answered.release()
        latencies.sort()
        print(f"one receiver in an open stream: median {latencies[100] * 1e3:.1f} ms, p99 {latencies[198] * 1e3:.1f} ms")

    def test_failures_have_reasons(self):
        for call, reason in [
            (lambda: self.client.job("nobody"), "NOT_FOUND"),
            (lambda: self.client.submit_build("a b", ["/x"], "/y"), "INVALID"),
            (lambda: self.client.scene("/nowhere/at/all"), "NOT_FOUND"),
            (lambda: self.client.shade_points("/nowhere", np.zeros((1, 3)), np.zeros((1, 3))), "NOT_FOUND"),
        ]:
            with self.assertRaises(pbgi.Error) as caught:
                call()
            self.assertEqual(caught.exception.reason, reason)
        self.client.submit_build("bad", [str(self.daemon.folder / "none.ply")], str(self.daemon.folder / "s.pbgi"))
        with self.assertRaises(pbgi.Error) as caught:
            self.client.wait("bad")
        self.assertEqual(caught.exception.reason, "FAILED")
        self.assertIn("none.ply", caught.exception.text)
        with self.assertRaises(ValueError):
            self.client.shade_points("/s", np.zeros((2, 3)), np.zeros((3, 3)))


ROOTS = """
[roots.in]
path = "FOLDER/in"
read = true
write = true
"""


def free_port() -> int:
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return found.getsockname()[1]


class Tcp(unittest.TestCase):
    def test_loopback(self):
        port = free_port()
        auth = f'[tcp]\naddress = "127.0.0.1:{port}"\nauth = "DANGEROUSLY_INSECURE"\n'
        daemon = Daemon(ROOTS + auth)
        daemon.make_scene()
        with pbgi.Client(f"127.0.0.1:{port}") as client:
            shade(self, client, "in:scene.ply", "in:scene.pbgi")
        daemon.stop()

    @unittest.skipUnless(shutil.which("openssl"), "SKIPPED: no openssl to make certificates with")
    def test_mutual_tls_and_token(self):
        folder, port = pathlib.Path(tempfile.mkdtemp()), free_port()

        def openssl(*arguments: str) -> None:
            subprocess.run(["openssl", *arguments], cwd=folder, check=True, capture_output=True)

        name = ["-subj", "/CN=localhost", "-addext", "subjectAltName=DNS:localhost"]
        new = ["req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes", "-days", "2"]
        openssl(*new, "-keyout", "ca.key", "-out", "ca.pem", "-subj", "/CN=ca")
        leaf = ["-addext", "basicConstraints=critical,CA:FALSE", "-CA", "ca.pem", "-CAkey", "ca.key"]
        openssl(*new, *name, *leaf, "-keyout", "key", "-out", "cert")
        (folder / "token").write_text("0123456789abcdef" * 3)
        for secret in ["key", "token"]:
            (folder / secret).chmod(0o600)
        paths = {name: str(folder / name) for name in ["cert", "key", "token", "ca.pem"]}
        config = ROOTS + f'[tcp]\naddress = "127.0.0.1:{port}"\ncert = "{paths["cert"]}"\nkey = "{paths["key"]}"\n'
        config += f'client_ca = "{paths["ca.pem"]}"\ntoken_file = "{paths["token"]}"\n'
        daemon = Daemon(config)
        identity = {"ca": paths["ca.pem"], "cert": paths["cert"], "key": paths["key"]}
        with pbgi.Client(f"localhost:{port}", **identity, token_file=paths["token"]) as client:
            self.assertEqual(client.status().pid, daemon.process.pid)
        with pbgi.Client(f"localhost:{port}", **identity) as client:
            with self.assertRaises(pbgi.Error) as caught:
                client.status()
            self.assertEqual(caught.exception.reason, "UNAUTHENTICATED")
        # The command line finds the same files where it looks for them.
        home = folder / "config/pbgi/tls"
        home.mkdir(parents=True)
        for name, ours in [("ca.pem", "ca.pem"), ("cert.pem", "cert"), ("key.pem", "key"), ("token", "token")]:
            shutil.copy(folder / ours, home / name)
        command = [BIN / "pbgi-client", "status", "--server", f"https://localhost:{port}"]
        environment = {**os.environ, "XDG_CONFIG_HOME": str(folder / "config")}
        told = subprocess.run(command, env=environment, capture_output=True, text=True)
        self.assertIn(f"pid {daemon.process.pid}", told.stdout, told.stderr)
        daemon.stop()
        shutil.rmtree(folder)


class Generated(unittest.TestCase):
    def test_messages_are_those_of_the_definitions(self):
        try:
            from generate import generate
        except ImportError:
            self.skipTest("SKIPPED: no grpcio-tools")
        with tempfile.TemporaryDirectory() as folder:
            generate(pathlib.Path(folder))
            for path in pathlib.Path(folder).rglob("*.py"):
                ours = HERE.parent / path.relative_to(folder)
                strip = lambda text: [line for line in text.splitlines() if "ersion" not in line and "VERSION" not in line]
                self.assertEqual(strip(path.read_text()), strip(ours.read_text()), f"{ours.name}: run tests/generate.py")


if __name__ == "__main__":
    unittest.main()
