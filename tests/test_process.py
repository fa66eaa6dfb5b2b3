import os
import subprocess
import sys
from pathlib import Path

import pytest

from softgm_bench import process


def python(code, **variables):
    environment = {
        name: value for name, value in os.environ.items() if name not in {*process.SETTINGS, "OMP_WAIT_POLICY"}
    } | variables
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_importing_the_package_sets_no_variable_and_loads_no_torch():
    code = (
        "import os, sys; before = dict(os.environ); import softgm_bench; "
        "print(before == dict(os.environ), 'torch' in sys.modules)"
    )
    assert python(code) == "True False"


def test_what_users_need_is_found_when_it_is_asked_for():
    code = (
        "import softgm_bench as s; from softgm_bench.envs import SoftArmEnv; "
        "print(s.SoftArmEnv is SoftArmEnv, all(callable(getattr(s, n)) for n in s.__all__ if n != '__version__'), "
        "set(s.__all__) <= set(dir(s)), s.__version__)"
    )
    assert python(code) == "True True True 0.1.0"


def test_an_unknown_name_is_an_attribute_error():
    code = "import softgm_bench\ntry: softgm_bench.nothing\nexcept AttributeError as error: print(error)"
    assert python(code) == "module 'softgm_bench' has no attribute 'nothing'"


def test_what_the_user_has_set_stays(monkeypatch):
    for name in process.SETTINGS:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("OMP_WAIT_POLICY", "passive")
    monkeypatch.setenv("ONEDNN_MAX_CPU_ISA", "AVX2")
    process.prepare()
    assert "GOMP_SPINCOUNT" not in os.environ
    assert os.environ["ONEDNN_MAX_CPU_ISA"] == "AVX2"
    monkeypatch.delenv("OMP_WAIT_POLICY")
    process.prepare()
    assert os.environ["GOMP_SPINCOUNT"] == "2000"


def test_products_stay_float32_whatever_came_before():
    code = (
        "import torch\n{before}\nfrom softgm_bench.runs.machine import set_threads\nset_threads(1)\n"
        "x = torch.full((64, 64), 1.0 + 2.0**-12); print(torch.equal(x @ torch.eye(64), x))"
    )
    use_onednn = "torch.backends.mkldnn.matmul.fp32_precision = 'bf16'; torch.ones(64, 64) @ torch.ones(64, 64)"
    use_onednn += "; torch.backends.mkldnn.matmul.fp32_precision = 'none'"
    for before in ("", use_onednn):
        assert python(code.format(before=before)) == "True"


def test_products_are_rounded_where_that_is_asked_for_and_the_processor_can():
    code = (
        "import torch\nfrom softgm_bench.errors import UserError\nfrom softgm_bench.runs.machine import set_threads\n"
        "try: set_threads(1, 'bf16')\nexcept UserError as error: print(error)\n"
        "x = torch.full((64, 64), 1.0 + 2.0**-12); print(torch.equal(x @ torch.eye(64), x))\n"
        "set_threads(1); print(torch.equal(x @ torch.eye(64), x))"
    )
    refused = "matmul=bf16: this processor has no instructions for it; choose float32, or null\nTrue\nTrue"
    about = Path("/proc/cpuinfo")
    able = about.exists() and {"avx512_bf16", "amx_bf16"} & set(about.read_text().split())
    assert python(code, ONEDNN_MAX_CPU_ISA="AVX2") == refused
    assert python(code) == ("False\nTrue" if able else refused)


@pytest.mark.slow
def test_asking_for_the_python_interface_prepares_the_process_before_torch_is_loaded():
    seen = "print(os.environ['GOMP_SPINCOUNT'], os.environ['ONEDNN_MAX_CPU_ISA'])"
    for asking in ("softgm_bench.train", "from softgm_bench import api"):
        assert python(f"import os, softgm_bench; {asking}; {seen}") == "2000 AVX512_CORE"
    noted = (
        "import sys, softgm_bench\nfrom softgm_bench import process\n"
        "process.prepare = lambda: print('torch' in sys.modules)\nsoftgm_bench.load"
    )
    assert python(noted) == "False"
