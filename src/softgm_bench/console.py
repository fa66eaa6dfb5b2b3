"""What the console command says of itself, and what a shell may complete after it; nothing here needs torch.

``softgm-bench COMMAND ...`` is ``python -m softgm_bench.COMMAND ...``; without a command's name it trains.
"""

from dataclasses import fields
from importlib import import_module

from softgm_bench import __version__
from softgm_bench.config import CHANGEABLE

COMMANDS = {
    "train": "one run, or with -m a grid of them",
    "evaluate": "how well a policy does, with intervals",
    "render": "a picture, a video or an interactive page of an episode",
    "watch": "a run while it learns: its newest checkpoint plays",
    "attention": "where a policy looks, step by step",
    "replay": "a recorded episode again, in this simulator or in PyElastica",
    "report": "tables and figures of many runs",
    "status": "what has become of the runs in a folder",
    "dataset": "transitions of a mix of policies, for offline learning",
    "certify": "which scenes of a task can be solved: actions that do",
    "export": "the policy of a run as one small file",
}
VERSION = f"softgm-bench {__version__}"
HELP = """\
A soft robotic arm whose sections learn to reach targets together: train, evaluate, look.

  softgm-bench render experiments/policies/wall_softgm.pt out=arm.html  # see a trained arm
  softgm-bench train algo=softgm task=basic experiment=quick            # 20 minutes on two cores
  softgm-bench evaluate outputs/basic/softgm/seed0 perturbation=noise   # with noisy senses

Commands:
{commands}

softgm-bench COMMAND --help lists a command's settings, written key=value, and their defaults.
A mistake is answered by one line that says what would be right. Ctrl-C leaves a run that
resume=true resumes. Without a command softgm-bench trains, as python -m softgm_bench does.

In Python: softgm_bench.train, load, evaluate, make_env. --version prints the version.
Completion in bash, for zsh and fish likewise: eval "$(softgm-bench -sc install=bash)"
""".format(commands="\n".join(f"  {name:<11}{text}" for name, text in COMMANDS.items()))


def completions(line: str) -> tuple[list[str], str | None]:
    """Complete a command line's last word.

    Args:
        line: as the shell has it, up to the cursor.

    Returns:
        What the last word may become, and the line with which Hydra is to be asked for settings of a training;
        None where it has nothing to say.
    """
    words = line.split()
    if not words or line[-1].isspace():
        words.append("")
    command, last = (words[1] if len(words) > 1 else ""), words[-1]
    if len(words) <= 2:
        return [name for name in COMMANDS if name.startswith(last)], line
    if command == "train":
        return [], " ".join([words[0], *words[2:]])
    if command in COMMANDS:
        return [f"{key}=" for key in _settings(command) if f"{key}=".startswith(last)], None
    return [], line


def _settings(command: str) -> list[str]:
    """A command's own settings, and those of policies where it acts with one."""
    name = f"softgm_bench.{command}"
    options = getattr(import_module(f"{name}.__main__" if command == "render" else name), "Options", None)
    own = [field.name for field in fields(options)] if options is not None else []
    return own + (list(CHANGEABLE) if command in ("attention", "dataset", "evaluate", "render") else [])
