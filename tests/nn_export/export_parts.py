"""What the tests of the export share."""

import torch
from torch import nn

from nn_export import trace


class Call(nn.Module):
    """A function of one tensor as a module."""

    def __init__(self, f):
        super().__init__()
        self.f = f

    def forward(self, x):
        return self.f(x)


class Cell(nn.Module):
    """(x, h, u) -> (x_next, h_next): a linear layer, a GRU cell with its own Jacobian, and scalar code between."""

    def __init__(self, z):
        super().__init__()
        torch.manual_seed(1)
        self.cell, self.head = nn.GRUCell(3, z), nn.Linear(z, 2)

    def forward(self, x, h, u):
        h_next = self.cell(torch.cat([torch.sin(x), u]), h)
        return 0.9 * x + 0.1 * self.head(h_next), h_next


def traced_cell(z):
    examples = torch.zeros(2), torch.zeros(z), torch.zeros(1)
    return trace(Cell(z), examples, output_names=["x_next", "h_next"])
