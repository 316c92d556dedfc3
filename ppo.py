"""Proximal Policy Optimisation for dict observations and continuous actions (Schulman et al., 2017), one rank or many.

    L = -E[min(ratio A, clip(ratio, 1 - eps, 1 + eps) A)] + c_v E[(V - R)^2] / 2 - c_e H + auxiliary

`agent(obs) -> (mean (B, A), log_std (A,), value (B,))` is all it asks of a network, reset and step of an environment
(Gymnasium's signatures). Every rank steps its own environments; ranks average gradients and advantage statistics over
torch.distributed (as in DD-PPO), so n ranks give the gradient of one rank on the joined batch.

Shapes: T steps of a rollout, E environments of this rank, B = T * E samples, A actions; buffers are (T, E, ...).
Run:    python ppo.py        learns to reach a random point on a line, in a few seconds
"""
import math

import numpy as np
import torch
import torch.distributed as dist
from torch import nn


def gae(rewards, values, next_values, terminated, done, discount, lam):
    """Generalised advantage estimation (Schulman et al., 2016), all inputs (T, E): returns advantages (T, E).

    next_values[t] is the value of the observation that step t led to; at the end of an episode that is the final
    observation, not the first one of the next episode. A termination has no future, so delta drops that value; a
    truncation has one, so delta keeps it. The recursion is cut wherever an episode ends, for either reason (`done`).
    """
    advantages, following = torch.zeros_like(rewards), torch.zeros_like(rewards[0])
    for t in reversed(range(len(rewards))):
        delta = rewards[t] + discount * (1 - terminated[t]) * next_values[t] - values[t]
        following = advantages[t] = delta + discount * lam * (1 - done[t]) * following
    return advantages


def normal_log_prob(actions, mean, log_std):
    """Log density (B,) of actions (B, A) under a diagonal Gaussian."""
    return (-0.5 * ((actions - mean) * torch.exp(-log_std)) ** 2 - log_std - 0.5 * math.log(2 * math.pi)).sum(-1)


def rank_mean(tensor):
    """Mean of a tensor over all ranks, in place; with one rank the tensor itself."""
    if dist.is_initialized():
        dist.all_reduce(tensor)
        tensor /= dist.get_world_size()
    return tensor


class PPO(nn.Module):
    """The learner: agent, optimiser and value normaliser. Arguments are named as in the literature; per rank:

    envs, steps     E environments, T steps each: a batch of T * E, cut into `minibatches` equal parts (ValueError if it
                    does not divide) and passed over `epochs` times
    anneal_lr, anneal_clip          multiply the learning rate / the clip range by the share of training that is left
    normalize_advantages            to mean 0 and standard deviation 1 over the whole batch of all ranks
    normalize_values                the value network learns (return - running mean) / running std
    auxiliary       weight of `agent.auxiliary(obs)`, an extra loss on each minibatch; 0: never called

    Random numbers come from torch's global generator: seed it before rollout() and an update repeats exactly.
    """

    def __init__(self, agent, envs, *, steps=250, epochs=5, minibatches=8, lr=1e-3, adam_eps=1e-5, clip=0.2, discount=0.98, lam=0.95,
                 entropy=0.001, value_coef=0.5, max_grad_norm=0.5, anneal_lr=True, anneal_clip=False,
                 normalize_advantages=True, normalize_values=True, auxiliary=0.0):
        super().__init__()
        if (steps * len(envs)) % minibatches:
            raise ValueError(f"a batch of {steps} steps x {len(envs)} environments does not divide into {minibatches} minibatches")
        self.agent, self.envs = agent, envs
        self.steps, self.epochs, self.minibatches = steps, epochs, minibatches
        self.lr, self.clip, self.discount, self.lam = lr, clip, discount, lam
        self.entropy, self.value_coef, self.max_grad_norm = entropy, value_coef, max_grad_norm
        self.anneal_lr, self.anneal_clip, self.auxiliary = anneal_lr, anneal_clip, auxiliary
        self.normalize_advantages, self.normalize_values = normalize_advantages, normalize_values
        self.register_buffer("return_mean", torch.zeros(()))
        self.register_buffer("return_square", torch.ones(()))
        self.register_buffer("return_batches", torch.zeros(()))
        # Weights and gradients become views of one vector each: averaging, clipping and Adam are then a few operations in
        # all instead of a few per layer, which on small networks costs as much as the matrix products.
        parameters = list(agent.parameters())
        self.weights = nn.utils.parameters_to_vector(parameters).detach()
        self.weights.grad = torch.zeros_like(self.weights)
        nn.utils.vector_to_parameters(self.weights, parameters)
        for p, grad in zip(parameters, self.weights.grad.split([p.numel() for p in parameters])):
            p.grad = grad.view_as(p)
        self.optimizer = torch.optim.Adam([self.weights], lr=lr, eps=adam_eps)
        self.buffer = None

    def return_std(self):
        return (self.return_square - self.return_mean ** 2).clamp(min=1e-8).sqrt()

    @torch.no_grad()
    def rollout(self, seeds):
        """Play T steps in every environment, from a fresh episode each (`seeds`, one per environment).

        Starting fresh makes an update a function of weights and seeds alone, which is what lets a run resume exactly.
        Returns the list of finished episodes as (return, length, info of the last step).
        """
        T, E, first = self.steps, len(self.envs), [env.reset(seed=seed)[0] for env, seed in zip(self.envs, seeds)]
        if self.buffer is None:
            self.buffer = {key: torch.zeros(T, E, *value.shape) for key, value in first[0].items()}
            self._views = {key: value.numpy() for key, value in self.buffer.items()}
        for key, view in self._views.items():
            view[0] = [obs[key] for obs in first]
        rewards, terminated, done = (np.zeros((T, E), np.float32) for _ in range(3))
        means, values, actions, noise = [], [], [], None
        finished, ends, totals, lengths = [], {}, np.zeros(E), np.zeros(E, int)
        for t in range(T):
            mean, log_std, value = self.agent({key: value[t] for key, value in self.buffer.items()})
            if noise is None:
                noise = torch.randn(T, *mean.shape) * log_std.exp()
            actions.append(mean + noise[t])
            means.append(mean)
            values.append(value)
            for e, (env, action) in enumerate(zip(self.envs, actions[t].numpy())):
                obs, rewards[t, e], terminated[t, e], truncated, info = env.step(action)
                totals[e] += rewards[t, e]
                lengths[e] += 1
                if terminated[t, e] or truncated or t == T - 1:
                    done[t, e], ends[t, e] = True, obs
                if terminated[t, e] or truncated:
                    finished.append((totals[e], int(lengths[e]), info))
                    totals[e] = lengths[e] = 0
                    obs = env.reset()[0] if t < T - 1 else obs
                if t < T - 1:
                    for key, view in self._views.items():
                        view[t + 1, e] = obs[key]
        std = self.return_std() if self.normalize_values else 1.0
        shift = self.return_mean if self.normalize_values else 0.0
        values = torch.stack(values)                                           # (T, E), in the network's units
        next_values = torch.cat([values[1:], values[:1]])                      # its last row is overwritten by `ends`
        last = {key: torch.from_numpy(np.stack([obs[key] for obs in ends.values()])) for key in self.buffer}
        next_values[tuple(torch.tensor(list(ends)).T)] = self.agent(last)[2]
        rewards, terminated, done = (torch.from_numpy(x) for x in (rewards, terminated, done))
        plain = values * std + shift
        advantages = gae(rewards, plain, next_values * std + shift, terminated, done, self.discount, self.lam)
        returns = advantages + plain
        self.explained_variance = 1 - (returns - plain).var() / returns.var().clamp(min=1e-8)
        actions, means = torch.stack(actions), torch.stack(means)
        self.batch = {"actions": actions, "log_prob": normal_log_prob(actions, means, log_std), "advantages": advantages,
                      "returns": returns}
        return finished

    def loss(self, obs, actions, log_prob, advantages, returns, clip):
        """PPO's loss on one minibatch (see the module's first lines) and its diagnostics."""
        mean, log_std, value = self.agent(obs)
        log_ratio = normal_log_prob(actions, mean, log_std) - log_prob
        ratio = log_ratio.exp()
        policy_loss = -torch.min(ratio * advantages, ratio.clamp(1 - clip, 1 + clip) * advantages).mean()
        value_loss = 0.5 * (value - returns).square().mean()
        entropy = (log_std + 0.5 * math.log(2 * math.pi * math.e)).sum()
        loss = policy_loss + self.value_coef * value_loss - self.entropy * entropy
        auxiliary = self.agent.auxiliary(obs) if self.auxiliary else torch.zeros(())
        with torch.no_grad():
            stats = {"policy_loss": policy_loss, "value_loss": value_loss, "auxiliary_loss": auxiliary, "entropy": entropy,
                     "approx_kl": ((ratio - 1) - log_ratio).mean(),            # k3 (Schulman, 2020): unbiased, never negative
                     "clip_fraction": ((ratio - 1).abs() > clip).float().mean()}
        return loss + self.auxiliary * auxiliary, stats

    def update(self, left):
        """Improve the agent on the last rollout; `left` is the share of training that is left. Returns mean diagnostics.

        FloatingPointError if a loss or gradient is not finite; the weights are then as before that step.
        """
        lr = self.lr * (left if self.anneal_lr else 1.0)
        clip = self.clip * (left if self.anneal_clip else 1.0)
        for group in self.optimizer.param_groups:
            group["lr"] = lr
        batch = {key: value.flatten(0, 1) for key, value in {**self.buffer, **self.batch}.items()}     # (B, ...)
        moments = rank_mean(torch.stack([x for key in ("returns", "advantages")
                                         for x in (batch[key].mean(), batch[key].square().mean())]))
        if self.normalize_values:                              # running moments: plain mean at first, then over ~100 batches
            self.return_batches += 1
            rate = max(1 / self.return_batches.item(), 0.01)
            self.return_mean += rate * (moments[0] - self.return_mean)
            self.return_square += rate * (moments[1] - self.return_square)
            batch["returns"] = (batch["returns"] - self.return_mean) / self.return_std()
        if self.normalize_advantages:
            std = (moments[3] - moments[2] ** 2).clamp(min=0).sqrt()
            batch["advantages"] = (batch["advantages"] - moments[2]) / (std + 1e-8)
        gradient, names, total = self.weights.grad, list(self.buffer), {}
        for _ in range(self.epochs):
            for rows in torch.randperm(len(batch["returns"])).chunk(self.minibatches):
                part = {key: value[rows] for key, value in batch.items()}
                loss, stats = self.loss({key: part.pop(key) for key in names}, **part, clip=clip)
                gradient.zero_()
                loss.backward()                                # adds to `gradient` through the views
                norm = stats["grad_norm"] = rank_mean(gradient).norm()
                if not torch.isfinite(norm):
                    raise FloatingPointError(f"the gradient is not finite (loss {loss.item()})")
                gradient *= (self.max_grad_norm / (norm + 1e-6)).clamp(max=1.0)
                self.optimizer.step()
                for key, value in stats.items():
                    total[key] = total.get(key, 0.0) + value.detach() / (self.epochs * self.minibatches)
        total["explained_variance"] = self.explained_variance
        values = rank_mean(torch.stack([torch.as_tensor(v, dtype=torch.float32) for v in total.values()]))
        return {**dict(zip(total, values.tolist())), "lr": lr}


class PointOnLine:
    """A 1-D example: move a point by at most 0.2 a step until it is within 0.1 of a target; reward -distance."""

    def reset(self, *, seed=None, options=None):
        if seed is not None:
            self.rng = np.random.default_rng(seed)
        self.x, self.target, self.steps = *self.rng.uniform(-1, 1, 2), 0
        return {"x": np.array([self.x, self.target], np.float32)}, {}

    def step(self, action):
        self.x, self.steps = self.x + 0.2 * float(np.clip(action[0], -1, 1)), self.steps + 1
        gap = abs(self.x - self.target)
        return {"x": np.array([self.x, self.target], np.float32)}, -gap, bool(gap < 0.1), self.steps >= 20, {"gap": gap}


class TinyAgent(nn.Module):
    """Two small networks and a free standard deviation: the agent contract in ten lines."""

    def __init__(self):
        super().__init__()
        self.mean, self.value = (nn.Sequential(nn.Linear(2, 32), nn.Tanh(), nn.Linear(32, 1)) for _ in range(2))
        self.log_std = nn.Parameter(torch.full((1,), -0.5))

    def forward(self, obs):
        return self.mean(obs["x"]), self.log_std, self.value(obs["x"]).squeeze(-1)


if __name__ == "__main__":
    torch.manual_seed(0)
    learner = PPO(TinyAgent(), [PointOnLine() for _ in range(8)], steps=64, lr=3e-3)
    for update in range(30):
        episodes = learner.rollout([1000 * update + e for e in range(8)])
        stats = learner.update(1 - update / 30)
        if update % 5 == 4:
            print(f"update {update + 1:2d}: mean return {np.mean([e[0] for e in episodes]):6.2f}, mean final gap "
                  f"{np.mean([e[2]['gap'] for e in episodes]):.2f}, KL {stats['approx_kl']:.4f}, "
                  f"explained variance {stats['explained_variance']:.2f}")
