"""TorchRL's squashed Gaussian between -1 and 1."""

from torch import Tensor
from torchrl.modules import TanhNormal
from torchrl.modules.distributions.continuous import SafeTanhTransform


class SquashedNormal(TanhNormal):
    """``TanhNormal`` that is made without a look at the device or a copy to it.

    TorchRL's puts the bounds -1 and 1 on the device, waiting for it twice, and asks whether they are these; a CUDA
    graph cannot be recorded over that.
    """

    non_trivial_max = non_trivial_min = False

    def __init__(self, loc: Tensor, scale: Tensor, upscale: float = 5.0, event_dims: int = 1, tanh_loc: bool = False):
        """Squash a Gaussian; arguments as of ``TanhNormal``."""
        self.low, self.high, self.upscale = -1.0, 1.0, upscale
        self.tanh_loc, self._event_dims, self.device = tanh_loc, event_dims, loc.device
        self._t = SafeTanhTransform()
        self.update(loc, scale)
