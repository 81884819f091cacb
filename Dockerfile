# ROS 2 Jazzy with monoforce_ros built the way README.md and docs/install.md do it on a robot.
#   docker build -t monoforce_ros .
#   docker run --rm --net=host monoforce_ros ros2 run monoforce_ros predictor --ros-args -p robot:=husky
# On a machine with a GPU: --build-arg TORCH_INDEX=https://pypi.org/simple and docker run --gpus all.
FROM ros:jazzy-ros-base-noble

ARG TORCH_INDEX=https://download.pytorch.org/whl/cpu
SHELL ["/bin/bash", "-c"]
ENV DEBIAN_FRONTEND=noninteractive

RUN apt-get update && apt-get install -y --no-install-recommends \
    g++ libosmesa6 make python3-dev python3-pip python3-venv \
    && rm -rf /var/lib/apt/lists/*

# Dependencies first: they change less often than the code.
WORKDIR /ros_ws
COPY package.xml src/monoforce_ros/package.xml
COPY msg_defs/monoforce_msgs/package.xml src/monoforce_ros/msg_defs/monoforce_msgs/package.xml
RUN apt-get update && rosdep update --rosdistro jazzy \
    && rosdep install --from-paths src --ignore-src -r -y --rosdistro jazzy \
    && rm -rf /var/lib/apt/lists/*
COPY requirements-robot.txt constraints-jazzy.txt src/monoforce_ros/
RUN python3 -m venv --system-site-packages .venv && touch .venv/COLCON_IGNORE \
    && .venv/bin/pip install --no-cache-dir --index-url "$TORCH_INDEX" -c src/monoforce_ros/constraints-jazzy.txt torch \
    && .venv/bin/pip install --no-cache-dir -r src/monoforce_ros/requirements-robot.txt

COPY . src/monoforce_ros
RUN source /opt/ros/jazzy/setup.bash && source .venv/bin/activate \
    && python -m colcon build --base-paths src/monoforce_ros src/monoforce_ros/msg_defs/monoforce_msgs \
      --cmake-args -DBUILD_TESTING=OFF \
    && source install/setup.bash && ros2 run monoforce_ros predictor --help >/dev/null

# The image's own entry point sources /opt/ros; the workspace is sourced on top of it.
RUN echo 'source /ros_ws/install/setup.bash' >>/root/.bashrc \
    && sed -i 's#^exec "\$@"#source /ros_ws/install/setup.bash --\nexec "$@"#' /ros_entrypoint.sh
CMD ["bash"]
