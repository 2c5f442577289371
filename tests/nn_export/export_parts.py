"""What the tests of the export share."""

from torch import nn


class Call(nn.Module):
    """A function of one tensor as a module."""

    def __init__(self, f):
        super().__init__()
        self.f = f

    def forward(self, x):
        return self.f(x)
