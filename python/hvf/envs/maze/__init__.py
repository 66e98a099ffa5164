"""The maze as Gymnasium environments."""
