"""From a hint to a grasp: who says where, and how the hand takes hold of it."""
