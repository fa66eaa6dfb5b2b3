"""Which rod runs where, by name."""

import subprocess
import sys
from importlib import import_module
from types import SimpleNamespace

import pytest

from softgm_bench.rod import backend
from softgm_bench.rod.backend import BACKENDS, check_backend, default_backend, make_backend
from softgm_bench.rod.parameters import RodParameters

ARM = RodParameters(n_elements=4)


@pytest.mark.parametrize("name", BACKENDS)
def test_every_name_builds_its_own_backend(name: str):
    rod = make_backend(name, ARM)
    assert type(rod).__name__.lower() == f"{name}backend"
    assert rod.parameters is ARM


@pytest.mark.parametrize("name", BACKENDS)
def test_every_registered_class_is_where_the_registry_says(name: str):
    registered = backend._REGISTRY[name]
    assert callable(getattr(import_module(registered.module), registered.factory).control_step)


@pytest.mark.parametrize("device_type", ["cpu", "cuda"])
def test_a_device_has_one_default_backend_and_it_runs_there(device_type: str):
    assert sum(device_type in registered.default_on for registered in backend._REGISTRY.values()) == 1
    check_backend(default_backend(device_type), device_type)


def test_the_default_is_the_fused_kernel_of_the_device():
    assert (default_backend("cpu"), default_backend("cuda")) == ("numba", "cuda")


def test_a_device_that_no_backend_is_made_for_has_no_default():
    with pytest.raises(ValueError, match=r"^device=mps: no backend is made for it; choose device=cpu or cuda$"):
        default_backend("mps")


@pytest.mark.parametrize(
    ("name", "device_type"),
    [("numba", "cpu"), ("torch", "cpu"), ("torch", "cuda"), ("cuda", "cuda"), ("pyelastica", "cpu")],
)
def test_a_backend_passes_on_its_devices(name: str, device_type: str):
    check_backend(name, device_type)


@pytest.mark.parametrize(
    ("name", "device_type", "line"),
    [
        (
            "cuda",
            "cpu",
            "backend=cuda does not run on device=cpu: choose device=cuda, or backend=numba or torch or pyelastica",
        ),
        ("numba", "cuda", "backend=numba does not run on device=cuda: choose device=cpu, or backend=torch or cuda"),
        (
            "pyelastica",
            "cuda",
            "backend=pyelastica does not run on device=cuda: choose device=cpu, or backend=torch or cuda",
        ),
        ("torch", "mps", "backend=torch does not run on device=mps: choose device=cpu or cuda"),
    ],
)
def test_a_backend_is_refused_elsewhere_in_one_line_that_says_what_would_do(name: str, device_type: str, line: str):
    with pytest.raises(ValueError, match=f"^{line}$"):
        check_backend(name, device_type)


@pytest.mark.parametrize("ask", [lambda: make_backend("jax", ARM), lambda: check_backend("jax", "cpu")])
def test_an_unknown_name_is_refused_with_the_known_ones(ask):
    with pytest.raises(ValueError, match=r"^backend is 'jax': choose one of numba, torch, cuda, pyelastica$"):
        ask()


def test_a_line_of_the_registry_is_all_that_a_new_backend_needs(monkeypatch: pytest.MonkeyPatch):
    made = SimpleNamespace(MyBackend=lambda parameters: SimpleNamespace(parameters=parameters))
    monkeypatch.setitem(sys.modules, "my_backend", made)
    line = backend._Registered("my_backend", "MyBackend", ("xpu",), default_on=("xpu",))
    monkeypatch.setitem(backend._REGISTRY, "mine", line)
    assert make_backend("mine", ARM).parameters is ARM
    assert default_backend("xpu") == "mine"
    check_backend("mine", "xpu")
    with pytest.raises(ValueError, match=r"or backend=mine$"):
        check_backend("numba", "xpu")


def test_deciding_by_name_imports_neither_torch_nor_numba():
    code = (
        "import sys\n"
        "from softgm_bench.rod.backend import BACKENDS, check_backend, default_backend\n"
        "check_backend(default_backend('cuda'), 'cuda')\n"
        "assert BACKENDS and not {'torch', 'numba'} & set(sys.modules), sorted({'torch', 'numba'} & set(sys.modules))\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
