"""Environment-steps per second of `cablejax/ShapeCable-v0`, and of its form in JAX; errors of the package's controller.

python benchmarks/environment.py
"""

from __future__ import annotations

import argparse
import functools
import json
import os
import time
from typing import get_args

import gymnasium
import jax
import numpy as np

from cablejax.compiled_programs import keep_compiled_programs
from cablejax.control.shaping import load_model, make_controller
from cablejax.control.targets import Shape, make_target
from cablejax.dataset.schema import Randomisation
from cablejax.environment import ENVIRONMENT, LinkPolicy, MjxShapeCable, ShapeCableConfig
from cablejax.simulate.compile import compiler_options
from cablejax.solver_names import SolverName

VARIED = Randomisation(stiffness=(0.3, 3.0), damping=(0.3, 3.0), friction=(0.5, 2.0))


def steps_per_second(size: int, steps: int) -> dict[str, float]:
    """Random actions in many environments at once, resets and randomisation included, compilation excluded."""
    env = gymnasium.make_vec(
        ENVIRONMENT, size, vectorization_mode="vector_entry_point", config=ShapeCableConfig(randomisation=VARIED)
    )
    env.reset(seed=0)
    shape = (steps, *(env.action_space.shape or ()))
    actions = np.random.default_rng(0).uniform(-1, 1, shape).astype(np.float32)
    env.step(actions[0])
    wall, cpu = time.perf_counter(), time.process_time()
    for action in actions:
        env.step(action)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    return {"per_second": size * steps / wall, "per_processor_second": size * steps / cpu}


def pure_steps_per_second(size: int, steps: int) -> dict[str, float]:
    """The same for the environment of JAX, without resets: many actions in one compiled call."""
    env = MjxShapeCable(ShapeCableConfig(randomisation=VARIED))
    states = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), size))
    actions = np.random.default_rng(0).uniform(-1, 1, (steps, size, env.action_size)).astype(np.float32)

    @functools.partial(jax.jit, compiler_options=compiler_options())
    def run(states, actions):
        return jax.lax.scan(lambda state, action: (jax.vmap(env.step)(state, action), None), states, actions)[0]

    jax.block_until_ready(run(states, actions))
    wall, cpu = time.perf_counter(), time.process_time()
    jax.block_until_ready(run(states, actions))
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    return {"per_second": size * steps / wall, "per_processor_second": size * steps / cpu}


def baseline(weights: str, solver: SolverName) -> dict[str, dict[str, float]]:
    """Errors of one episode for each letter on varied cables [cm]."""
    model = load_model(weights)
    config = ShapeCableConfig(randomisation=VARIED, tolerance=1e-6)
    policy = LinkPolicy(config, lambda target: make_controller(model, target, method="residual", solver=solver))
    env, errors = gymnasium.make(ENVIRONMENT, config=config), {}
    for seed, letter in enumerate(get_args(Shape)):
        observation, info = env.reset(seed=seed, options={"target": letter})
        policy.begin(make_target(letter, config.cable))
        course, ended = [info["error"]], False
        while not ended:
            observation, _, terminated, truncated, info = env.step(policy(observation))
            course.append(info["error"])
            ended = terminated or truncated
        centimetres = 100 * config.cable.length * np.array(course)
        errors[letter] = {"start_cm": centimetres[0], "end_cm": centimetres[-1], "lowest_cm": centimetres.min()}
    return errors


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--envs", type=int, default=256)
    parser.add_argument("--steps", type=int, default=80)
    parser.add_argument("--weights", default="gns-reference")
    parser.add_argument("--solver", default="two-trials")
    options = parser.parse_args()
    keep_compiled_programs()
    sizes = options.envs, options.steps
    result = {"environments": options.envs, "gymnasium": steps_per_second(*sizes), "jax": pure_steps_per_second(*sizes)}
    result["load"] = os.getloadavg()
    print(json.dumps(result | {"baseline": baseline(options.weights, options.solver)}, indent=2))


if __name__ == "__main__":
    main()
