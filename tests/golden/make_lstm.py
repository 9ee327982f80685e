"""Writes lstm.npz: output, loss and gradient of torch.nn.LSTM with a linear head, in double precision.

The stored file lets every machine check the network against PyTorch without PyTorch. Run it again only if the
parameter layout changes:  python tests/golden/make_lstm.py
"""

from pathlib import Path

import numpy as np
import torch

INPUTS, HIDDEN, OUTPUTS, LENGTH, WINDOWS = 6, 20, 2, 100, 37


def main() -> None:
    rng = np.random.default_rng(20210530)
    torch.manual_seed(0)
    lstm = torch.nn.LSTM(INPUTS, HIDDEN, batch_first=True).double()
    head = torch.nn.Linear(HIDDEN, OUTPUTS).double()
    # Larger than the default initialisation, so that gates also saturate.
    for p in lstm.parameters():
        p.data = torch.from_numpy(rng.normal(0, 0.4, p.shape).astype(np.float32)).double()
    lstm.bias_hh_l0.data.zero_()  # one bias a gate here, as the sum of PyTorch's two
    for p in head.parameters():
        p.data = torch.from_numpy(rng.normal(0, 0.4, p.shape).astype(np.float32)).double()
    windows = rng.uniform(-1, 1, (WINDOWS, LENGTH, INPUTS)).astype(np.float32)
    targets = rng.uniform(-1, 1, (WINDOWS, OUTPUTS)).astype(np.float32)
    output = head(lstm(torch.from_numpy(windows).double())[0][:, -1])
    loss = torch.nn.functional.mse_loss(output, torch.from_numpy(targets).double())
    loss.backward()
    ordered = [lstm.weight_ih_l0, lstm.weight_hh_l0, lstm.bias_ih_l0, head.weight, head.bias]
    np.savez_compressed(
        Path(__file__).with_name("lstm.npz"),
        windows=windows,
        targets=targets,
        parameters=np.concatenate([p.detach().numpy().ravel() for p in ordered]).astype(np.float32),
        output=output.detach().numpy(),
        loss=loss.item(),
        gradient=np.concatenate([p.grad.numpy().ravel() for p in ordered]),
        torch_version=torch.__version__,
    )


if __name__ == "__main__":
    main()
