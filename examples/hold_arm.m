% Modbus TCP controller for Octave, without a Modbus library: moves the arm to a pose and holds it there.
% octave-cli hold_arm.m [PORT [SECONDS]]; needs Octave's package instrument-control for the socket.
1;
pkg load instrument-control

function data = receive(rig, count)
  data = read(rig, count);
  if numel(data) < count
    error("no response within %g s", get(rig, "Timeout"));
  end
end

function reply = transact(rig, request)
  % Send the bytes of a request to unit 1 in one segment, and return those of the response.
  write(rig, uint8([0 1 0 0 0 numel(request)+1 1 request]));
  header = double(receive(rig, 7));
  reply = receive(rig, 256*header(5) + header(6) - 1);
  if reply(1) > 127
    error("exception %02X", reply(2));
  end
end

function values = read_int16(rig, address, count)
  reply = transact(rig, [3 0 address 0 count]);
  values = double(swapbytes(typecast(uint8(reply(3:end)), "int16")));
end

function write_int16(rig, address, values)
  % int16 before typecast: uint8 and uint16 of a negative number are 0, without a message.
  bytes = typecast(swapbytes(int16(values)), "uint8");
  transact(rig, [16 0 address 0 numel(values) numel(bytes) double(bytes)]);
end

args = argv(); port = 5020; duration = 10;
if numel(args) > 0 port = str2double(args{1}); end
if numel(args) > 1 duration = str2double(args{2}); end
rig = tcpclient("127.0.0.1", port, "Timeout", 1);
GOAL = [30 -45 50 20]; LIMIT = [30 30 40 60];  % degrees, degrees, mm, degrees
KP = [0.25 0.25 0.03 0.004]; KD = [0.04 0.03 0.002 0.0005]; WEIGHT = [0 0 -4.905 0];
PERIOD = 0.02; before = []; speed = zeros(1, 4); begin = due = time();
while time() - begin < duration
  position = read_int16(rig, 4, 4) / 100;
  if !isempty(before) speed = 0.5*speed + 0.5*(position - before)/PERIOD; end
  before = position;
  torque = KP.*max(-LIMIT, min(LIMIT, GOAL - position)) - KD.*speed + WEIGHT;
  write_int16(rig, 0, 1000*torque);
  due += PERIOD; pause(max(0, due - time()));
end
printf("at the end: %s\n", mat2str(position));
clear rig
exit(max(abs(GOAL - position)) > 1);
