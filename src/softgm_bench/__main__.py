"""Train and evaluate: ``python -m softgm_bench algo=softgm task=wall seed=0``."""

import os
import sys

import hydra
from hydra._internal.utils import get_args_parser
from omegaconf import DictConfig

from softgm_bench.config import UserError, config_directory, typed, validate
from softgm_bench.experiment.explain import USER_ERRORS, explain


def main() -> int:
    """Run what the command line says; 0 when all went well, 2 after a user's error, 128 + signal when interrupted."""
    debugging = os.environ.get("HYDRA_FULL_ERROR") == "1"
    os.environ["HYDRA_FULL_ERROR"] = "1"  # let errors through instead of printing and leaving
    failures = 0

    def report(error: Exception) -> None:
        nonlocal failures
        failures += 1
        if debugging:
            raise error
        print(f"softgm_bench: {explain(error, sys.argv[1:])}", file=sys.stderr)

    def job(composed: DictConfig) -> None:  # a failing job of a sweep does not stop the others
        try:
            _train(composed)
        except USER_ERRORS as error:
            report(error)

    try:
        _refuse_unknown_options()
        hydra.main(version_base="1.3", config_path=str(config_directory()), config_name="config")(job)()
    except USER_ERRORS as error:
        report(error)
    except KeyboardInterrupt as interruption:
        print(f"softgm_bench: {str(interruption) or 'interrupted; nothing was saved'}", file=sys.stderr)
        return getattr(interruption, "exit_code", 130)
    return 2 if failures else 0


def _train(composed: DictConfig) -> None:
    config = typed(composed)
    validate(config)
    from softgm_bench.experiment.loop import train  # late: a refused command need not wait for torch

    train(config)


def _refuse_unknown_options() -> None:
    _, unknown = get_args_parser().parse_known_args()
    if unknown:
        name = unknown[0].lstrip("-").partition("=")[0]
        raise UserError(f"{unknown[0]}: no such option; settings are written without dashes: {name}=value")


if __name__ == "__main__":
    sys.exit(main())
