"""The arm in the interfaces of PettingZoo and Gymnasium."""
