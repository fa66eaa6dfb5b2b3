"""Composition of settings from ``conf/`` and the command line, held against the dataclasses.

Values live in YAML only, except the arm's, whose dataclass is the source. Hydra composes the YAML; ``typed`` then holds
it against the dataclasses, so a misspelt key or a wrong type is refused wherever it was written.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import asdict, fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any, get_origin, get_type_hints

from hydra import compose as hydra_compose
from hydra import initialize_config_dir
from hydra.core.config_store import ConfigStore
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from softgm_bench.config import numbers, resolvers
from softgm_bench.config.schema import PAPER, RECIPES, Config, group_schemas, model_name
from softgm_bench.config.upgrade import NEUTRAL, upgraded
from softgm_bench.errors import UserError
from softgm_bench.rod.parameters import RodParameters

# chosen by name, which trained policies can be evaluated with others of
GROUPS = ("task", "rod", "perturbation", "randomise")
CHANGEABLE = (*GROUPS, "backend", "dtype")
# A curriculum's limit of contact must fit the task's; where a policy plays by another limit there is no curriculum.
NO_EASIER_CONTACT = ("task.curriculum.easy_contact_steps=null", "task.curriculum.contact_stages=0")

resolvers.register()

# The arm's YAML is written by its dataclass, so that its values stand in one place.
ConfigStore.instance().store(group="rod", name="paper", node=asdict(RodParameters()))


def config_directory() -> Path:
    """Folder of the YAML files: inside an installed package, or at the top of the repository.

    Raises:
        UserError: there is none.
    """
    package = Path(__file__).resolve().parents[1]
    installed = package / "conf"
    found = installed if installed.is_dir() else package.parents[1] / "conf"
    if not found.is_dir():  # inside of an archive, where Hydra and Numba find nothing either
        raise UserError(f"{package}: no folder with the settings beside it: install the wheel, pip install FILE.whl")
    return found


def compose(overrides: list[str]) -> Config:
    """The configuration that ``python -m softgm_bench <overrides>`` means; only its types are checked.

    ``softgm_bench.assembly.configure`` also refuses values that make no sense.

    Raises:
        UserError: a value that a dataclass refuses.
        HydraException, OmegaConfBaseException: an override that cannot be read, a misspelt key or a wrong type.
    """
    return typed(compose_untyped(overrides))


def compose_untyped(overrides: list[str]) -> DictConfig:
    """Compose what the YAML files and the overrides say, before it is held against the dataclasses."""
    with initialize_config_dir(version_base="1.3", config_dir=str(config_directory())), composing():
        return hydra_compose("config", overrides)


@contextmanager
def composing() -> Iterator[None]:
    """Around Hydra's composition, which refuses some settings, such as ``task=0``, with an error of Python's own.

    Raises:
        UserError: instead of it.
    """
    try:
        yield
    except (ValueError, TypeError, AttributeError, AssertionError) as error:
        reason = next(iter(str(error).splitlines()), type(error).__name__)
        raise UserError(f"the settings cannot be composed: {reason}; task, algo and the like take a name") from error


def typed(composed: DictConfig) -> Config:
    """Hold a composed configuration, or one that was written down, against the dataclasses and make instances of them.

    Raises:
        UserError: a name that stands for nothing, a number that is not finite, a range upside down, or a value that a
            dataclass refuses.
        OmegaConfBaseException: a misspelt or missing key, a wrong type, or an interpolation that leads nowhere.
    """
    recipe = composed.get("recipe", NEUTRAL["recipe"])
    if recipe not in (*RECIPES, NEUTRAL["recipe"]):
        raise UserError(f"recipe: {recipe}: the key is {' or '.join(RECIPES)}, whatever the recipe's file is called")
    held: Any = OmegaConf.to_container(composed, resolve=True)
    schema, values = _schema(Config), OmegaConf.create(upgraded(held))
    schema.perturbation = _perturbation_schema()
    for group, schemas in group_schemas().items():
        name = OmegaConf.select(values, f"{group}.name")
        if name not in schemas:
            raise UserError(f"{group}.name={name}: no such {group}; choose one of {', '.join(schemas)}")
        schema[group] = _schema(schemas[name])
        if "name" not in get_type_hints(schemas[name]):
            del values[group]["name"]
    _fill(schema)
    numbers.check_finite(OmegaConf.to_container(values), schema)
    try:
        config = OmegaConf.to_object(OmegaConf.merge(schema, values))
    except OmegaConfBaseException:
        raise
    except ValueError as error:  # a dataclass refuses its values with one line
        raise UserError(str(error)) from error
    assert isinstance(config, Config)
    _restore_tuples(config)
    numbers.check_ranges(config)
    numbers.check_depths(plain(config))
    return config


def plain(config: Config) -> dict[str, Any]:
    """The configuration as plain values; ``typed(OmegaConf.create(plain(config)))`` gives it back."""
    values = asdict(config)
    values["model"] = {"name": model_name(config.model)} | values["model"]
    return values


def changed(values: Mapping[str, Any], overrides: Sequence[str]) -> Config:
    """A run's configuration with other settings for the policy that it has trained; not validated.

    Args:
        values: what ``plain`` gave.
        overrides: ``key=value`` each. The name of a group replaces all of the group by what ``conf/`` says under
            the run's recipe, whatever stands where; then dotted keys change single values, the last one of a key last.

    Raises:
        UserError: a setting that cannot be read, or that training has settled.
        HydraException, OmegaConfBaseException: an unknown group, a misspelt key or a wrong type.
    """
    settings = OmegaConf.create(dict(values))
    single: list[str] = []
    for override in overrides:
        key, equals, name = override.partition("=")
        if not equals:
            raise UserError(f"{override}: settings are written key=value")
        if key.partition(".")[0] not in CHANGEABLE:
            raise UserError(f"{key}: not a setting of trained policies; those are {', '.join(CHANGEABLE)}")
        if key not in GROUPS:
            single.append(override)
        elif re.fullmatch(r"\w+", name):
            composed = compose_untyped([override, f"recipe={settings.get('recipe') or PAPER}"])
            chosen: Any = OmegaConf.to_container(composed, resolve=True)
            settings[key] = chosen[key]
        else:
            raise UserError(f"{override}: name one of the files in conf/{key}")
    if any(override.startswith("task.max_contact_steps=") for override in single):
        single = [*NO_EASIER_CONTACT, *single]
    try:
        return typed(OmegaConf.merge(settings, OmegaConf.from_dotlist(single)))  # type: ignore[arg-type]
    except YAMLError as error:
        raise UserError(f"{', '.join(single)}: a value that cannot be read") from error


def _fill(schema: DictConfig) -> None:
    """Give keys that runs of before do not have, nor perhaps tasks of others, the values that change nothing."""
    for key, value in NEUTRAL.items():
        group, _, name = key.rpartition(".")
        node = OmegaConf.select(schema, group) if group else schema
        if node is not None and name in list(node):
            node[name] = value


def _perturbation_schema() -> DictConfig:
    """Of every perturbation; runs from before there were any get the default, none."""
    from softgm_bench.envs.perturbation import PerturbationConfig

    return _schema(PerturbationConfig)


def _schema(cls: type) -> DictConfig:
    """Structured config of a dataclass, for the caller to change."""
    return deepcopy(_made_schema(cls))


@cache
def _made_schema(cls: type) -> DictConfig:
    """Made once, for it takes as long as all else that ``typed`` does.

    OmegaConf would keep a frozen dataclass read-only, even while merging.
    """
    node = OmegaConf.structured(cls)
    OmegaConf.set_readonly(node, False)
    hints = get_type_hints(cls)
    for item in fields(cls):
        if is_dataclass(hints[item.name]):
            node[item.name] = _made_schema(hints[item.name])
    return node


def _restore_tuples(instance: Any) -> None:
    """Turn the lists that OmegaConf leaves in fields of type tuple back, so that frozen dataclasses can be hashed."""
    hints = get_type_hints(type(instance))
    for item in fields(instance):
        value = getattr(instance, item.name)
        if is_dataclass(value):
            _restore_tuples(value)
        elif get_origin(hints[item.name]) is tuple:
            object.__setattr__(instance, item.name, tuple(value))
