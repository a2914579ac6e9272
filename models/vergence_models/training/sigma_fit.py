"""Training of the sigma head alone, on pixels of a network that stays as it is."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor, nn

from vergence_models.networks.lite.ambiguity import SigmaHead
from vergence_models.networks.losses import WITHIN_SIGMAS, doubt_loss
from vergence_models.progress import silent
from vergence_models.training.sigma_samples import SigmaSamples

BATCH = 8192
LEARNING_RATE = 1e-2
SURE_PX = 5.9  # sigma of a confidence of 40 of 255


def fit_sigma(
    head: SigmaHead,
    samples: SigmaSamples,
    *,
    steps: int,
    seed: int,
    on_step: Callable[[str], None] = silent,
) -> None:
    """Train the head from its start. The measures' means and spreads go into its first layer."""
    torch.manual_seed(seed)
    head.load_state_dict(SigmaHead().state_dict())
    mean, spread = samples.measures.mean(dim=0), samples.measures.std(dim=0) + 1e-3
    with torch.no_grad():
        # The spread of every input counts alike at first; a floor of a hundredth of a pixel.
        nn.init.normal_(head.leave.weight, std=0.05)
    scaled = (samples.measures - mean) / spread
    optimizer = torch.optim.AdamW(head.parameters(), lr=LEARNING_RATE, weight_decay=1e-4)
    for step in range(steps):
        for group in optimizer.param_groups:
            group["lr"] = LEARNING_RATE * (0.5 + 0.5 * math.cos(math.pi * step / steps))
        chosen = torch.randint(len(scaled), (BATCH,))
        sigma = predicted(head, scaled[chosen], samples.sigma[chosen])
        loss = doubt_loss(samples.error_px[chosen], sigma).mean()
        optimizer.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]  # torch annotates it so
        optimizer.step()
        on_step(f"loss {loss.item():.3f}")
    with torch.no_grad():
        assert head.enter.bias is not None
        weight = head.enter.weight / spread[None, :, None, None]
        head.enter.bias -= (weight * mean[None, :, None, None]).sum(dim=(1, 2, 3))
        head.enter.weight.copy_(weight)


def predicted(head: SigmaHead, measures: Tensor, sigma: Tensor) -> Tensor:
    """Sigma of pixels, [N]."""
    gain, floor = head.factors(measures[:, :, None, None])[:, :, 0, 0].unbind(dim=1)
    return sigma * gain + floor


@torch.inference_mode()
def measured(head: SigmaHead, samples: SigmaSamples) -> dict[str, float]:
    """Shares of errors within 1, 2 and 3 sigma where the disparity is shown, in percent.

    And of the pixels without evidence the share whose confidence is above 40 of 255.
    """
    sigma = predicted(head, samples.measures, samples.sigma)
    figures = {"loss": doubt_loss(samples.error_px, sigma).mean().item()}
    for name, kind in (("cold", samples.cold), ("warm", ~samples.cold)):
        shown = kind & ~samples.hidden
        for sigmas in WITHIN_SIGMAS:
            within = samples.error_px[shown] <= sigmas * sigma[shown]
            figures[f"{name}_within_{sigmas}"] = 100 * within.float().mean().item()
        sure = sigma[kind & samples.hidden] < SURE_PX
        figures[f"{name}_hidden_sure"] = 100 * sure.float().mean().item()
    return {name: round(value, 2) for name, value in figures.items()}
