"""The soft arm as TorchRL environments."""
