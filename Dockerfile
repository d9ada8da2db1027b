# SPDX-License-Identifier: Apache-2.0
# The suite on the stock image of ROS 2 Jazzy: docker build -t robocal_ros .
#   docker run --rm --net=host --ipc=host -v robocal_state:/state robocal_ros \
#       ros2 launch robocal_ros cell.launch.py simulated:=true
# --ipc=host: Fast DDS talks through shared memory with nodes of the host.
FROM ros:jazzy
SHELL ["/bin/bash", "-eo", "pipefail", "-c"]
WORKDIR /robocal_ros
COPY package.xml ./
COPY msg_defs/package.xml msg_defs/
RUN apt-get update \
    && apt-get install --yes --no-install-recommends python3-venv ros-jazzy-ros2launch \
    && rosdep update --rosdistro jazzy \
    && source /opt/ros/jazzy/setup.bash \
    && rosdep install --from-paths . msg_defs --ignore-src -y \
    && rm -rf /var/lib/apt/lists/*
COPY . .
RUN source /opt/ros/jazzy/setup.bash && tools/build_jazzy
ENV ROBOCAL_STATE=/state
VOLUME /state
# ros_entrypoint.sh of the image sources Jazzy; this workspace comes after it.
RUN sed -i '/^exec/i source /robocal_ros/install/setup.bash --' /ros_entrypoint.sh
CMD ["robocal", "--help"]
