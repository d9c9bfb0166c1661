"""What odometry and ego-motion share: features on a fisheye picture, and how a camera moved between two of them."""
